"""Initial-state buffers B_iota: the starts of a sub-task's attempts (paper, Algorithm 2, lines 1 and 4)."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

State = NDArray[Any]
RESET_SHARE = 0.5
CAPACITY = 200


@dataclass(frozen=True)
class StartState:
    """A product state <s, q> to begin an attempt in; ``state`` None means the environment's reset."""

    q: int
    state: State | None


class InitialStateBuffer:
    """Start states of one sub-task: a bounded FIFO per DFA state.

    Every entry has an increasing cursor, so that a remote copy can request new entries only.

    Args:
        capacity: maximum number of entries per DFA state; the oldest are dropped first.
        repeats: store duplicates, as the paper does.
    """

    def __init__(self, capacity: int = CAPACITY, *, repeats: bool = False) -> None:
        self._capacity, self._repeats = capacity, repeats
        self._entries: dict[int, OrderedDict[bytes, tuple[int, State]]] = {}
        self.cursor = 0

    def __len__(self) -> int:
        return sum(len(entries) for entries in self._entries.values())

    def add(self, q: int, state: State) -> bool:
        """Store <state, q>; False if it is a duplicate and those are not stored."""
        entries = self._entries.setdefault(q, OrderedDict())
        key = self._key(state, self.cursor + 1)
        if key in entries:
            return False
        self.cursor += 1
        entries[key] = (self.cursor, state.copy())
        if len(entries) > self._capacity:
            entries.popitem(last=False)
        return True

    def remove(self, q: int, state: State) -> None:
        """Remove <state, q> and its duplicates, if present."""
        entries = self._entries.get(q, OrderedDict())
        wanted = state.tobytes()
        for key in [key for key in entries if key.startswith(wanted)] if self._repeats else [wanted]:
            entries.pop(key, None)

    def _key(self, state: State, number: int) -> bytes:
        return state.tobytes() + (number.to_bytes(8, "big") if self._repeats else b"")

    def since(self, cursor: int, limit: int) -> list[tuple[int, int, State]]:
        """Up to ``limit`` entries newer than ``cursor`` as (cursor, q, state), oldest first."""
        fresh = [
            (number, q, state)
            for q, entries in self._entries.items()
            for number, state in entries.values()
            if number > cursor
        ]
        return sorted(fresh, key=lambda entry: entry[0])[:limit]

    def states_present(self) -> list[int]:
        """DFA states with at least one entry, sorted."""
        return sorted(q for q, entries in self._entries.items() if entries)

    def count(self, q: int) -> int:
        """Number of entries of DFA state ``q``."""
        return len(self._entries.get(q, ()))

    def sample(self, q: int, rng: np.random.Generator) -> State:
        """Draw an entry of DFA state ``q`` uniformly."""
        entries = self._entries[q]
        index = int(rng.integers(len(entries)))
        return list(entries.values())[index][1]

    def state_dict(self) -> dict[str, Any]:
        """All entries in order, and the cursor, for a checkpoint."""
        entries = self.since(0, self.cursor)
        return {
            "cursor": self.cursor,
            "cursors": np.array([number for number, _, _ in entries], np.int64),
            "q": np.array([q for _, q, _ in entries], np.int32),
            "states": np.stack([state for *_, state in entries]) if entries else np.zeros((0, 0)),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore from ``state_dict``."""
        self._entries.clear()
        for number, q, entry in zip(state["cursors"].tolist(), state["q"].tolist(), state["states"], strict=True):
            self._entries.setdefault(q, OrderedDict())[self._key(entry, number)] = (number, entry.copy())
        self.cursor = state["cursor"]


def sample_starts(
    buffer: InitialStateBuffer, reset_q: int | None, count: int, rng: np.random.Generator, *, by_entry: bool = False
) -> Sequence[StartState]:
    """Draw ``count`` start states: uniform over the DFA states present, then uniform within.

    Args:
        buffer: of the sub-task.
        reset_q: the initial DFA state if the sub-task is available there, else None; the environment's reset is then an
            entry of it.
        count: number of starts.
        rng: random generator.
        by_entry: draw uniformly over all entries instead, the reset being one of them (the paper's B_iota).

    Returns:
        The starts; empty if there are none.
    """
    if by_entry:
        return _draw_entries(buffer, reset_q, count, rng)
    present = buffer.states_present()
    choices = sorted({*present, *(() if reset_q is None else (reset_q,))})
    if not choices:
        return []
    return [_draw(buffer, choices[i], reset_q, present, rng) for i in rng.integers(len(choices), size=count)]


def _draw(
    buffer: InitialStateBuffer, q: int, reset_q: int | None, present: list[int], rng: np.random.Generator
) -> StartState:
    if q == reset_q and (q not in present or rng.random() < RESET_SHARE):
        return StartState(q, None)
    return StartState(q, buffer.sample(q, rng))


def _draw_entries(
    buffer: InitialStateBuffer, reset_q: int | None, count: int, rng: np.random.Generator
) -> Sequence[StartState]:
    resets = [] if reset_q is None else [reset_q]
    owners = np.array(resets + [q for q in buffer.states_present() for _ in range(buffer.count(q))])
    if not len(owners):
        return []
    drawn = rng.integers(len(owners), size=count)
    return [StartState(int(owners[i]), None if i < len(resets) else buffer.sample(int(owners[i]), rng)) for i in drawn]
