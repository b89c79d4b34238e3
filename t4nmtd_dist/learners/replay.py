"""Replay of SAC's experiences: preallocated rings, batches drawn without a Python loop over rows.

DFA states are kept as numbers and become one-hots when a batch is drawn. Rows can be *marked* (the steps before a
success); a share of each batch can be drawn from the marked rows alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.errors import RunError
from t4nmtd_dist.learners.networks import Weights
from t4nmtd_dist.learners.sac_update import SACBatch

Floats = NDArray[np.float32]
Rows = NDArray[np.int64]

DTYPES: dict[str, type[np.generic]] = {"q": np.int32, "next_q": np.int32, "boundary": np.bool_}


@dataclass(frozen=True)
class Experiences:
    """k experiences, n steps each.

    Attributes:
        observations: where the first action was taken [k, d].
        q: DFA states there [k].
        actions: first actions, within [-1, 1] [k, A].
        rewards: discounted sums of scaled rewards [k].
        discounts: gamma**n, or 0 where the critic's value is terminal [k].
        next_observations: n steps later [k, d].
        next_q: DFA states there [k].
        boundary: whether the value there is a peer's [k].
    """

    observations: Floats
    q: NDArray[np.int32]
    actions: Floats
    rewards: Floats
    discounts: Floats
    next_observations: Floats
    next_q: NDArray[np.int32]
    boundary: NDArray[np.bool_]


class ReplayBatch:
    """Room for a batch of B rows: tensors for the update, and numpy views of the same memory for sampling.

    Attributes:
        tensors: what ``SACUpdater.update`` takes.
        rows: which rows of the replay were drawn [B].
        boundary_rows: rows *of the batch* whose next state belongs to a peer [k].
        boundary_observations: next observations of those [k, d].
        boundary_q: next DFA states of those [k].
    """

    def __init__(self, size: int, observation_size: int, dfa_states: int, action_size: int) -> None:
        self.tensors = SACBatch.empty(size, observation_size + dfa_states, action_size)
        self.states: Floats = self.tensors.states.numpy()
        self.next_states: Floats = self.tensors.next_states.numpy()
        self.actions: Floats = self.tensors.actions.numpy()
        self.rewards: Floats = self.tensors.rewards.numpy()
        self.discounts: Floats = self.tensors.discounts.numpy()
        self.rows: Rows = np.zeros(size, np.int64)
        self.boundary_rows: Rows = np.zeros(0, np.int64)
        self.boundary_observations: Floats = np.zeros((0, observation_size), np.float32)
        self.boundary_q: NDArray[np.int32] = np.zeros(0, np.int32)


class MarkedRows:
    """A bounded queue of rows, by their number since the beginning; the oldest go first.

    Args:
        capacity: how many are kept.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._numbers: Rows = np.zeros(capacity, np.int64)
        self._begin = self._end = 0

    def __len__(self) -> int:
        return self._end - self._begin

    def add(self, numbers: Rows) -> None:
        """Put rows at the end."""
        kept = numbers[-self.capacity :]
        self._end += len(numbers)
        self._numbers[np.arange(self._end - len(kept), self._end) % self.capacity] = kept
        self._begin = max(self._begin, self._end - self.capacity)

    def forget(self, oldest: int) -> None:
        """Drop rows in front that are older than ``oldest``; those behind a younger one wait for their turn."""
        while self._begin < self._end and self._numbers[self._begin % self.capacity] < oldest:
            self._begin += 1

    def draw(self, count: int, rng: np.random.Generator) -> Rows:
        """Rows drawn uniformly, with replacement."""
        return self._numbers[rng.integers(self._begin, self._end, count) % self.capacity]

    def all(self) -> Rows:
        """All rows, oldest first."""
        return self._numbers[np.arange(self._begin, self._end) % self.capacity]


class ReplayBuffer:
    """A ring of experiences.

    The loop it is meant for::

        numbers = replay.add(experiences)
        replay.mark(numbers_of_the_steps_before_a_success)
        replay.sample(batch, marked_share=0.25)
        updater.update(batch.tensors, PeerSoftValues(batch.boundary_rows, values, log_probs))

    Args:
        capacity: experiences kept; the oldest go first.
        observation_size: d.
        dfa_states: |Q|, the width of the one-hot; 0 for none.
        action_size: A.
        seed: of the sampling.
        marked_capacity: marked rows kept; None for ``capacity``.
    """

    def __init__(
        self,
        capacity: int,
        observation_size: int,
        dfa_states: int,
        action_size: int,
        *,
        seed: int,
        marked_capacity: int | None = None,
    ) -> None:
        self._capacity, self._dfa_states = capacity, dfa_states
        self._sizes = (observation_size, dfa_states, action_size)
        shapes: dict[str, tuple[int, ...]] = {
            "observations": (observation_size,),
            "next_observations": (observation_size,),
            "actions": (action_size,),
        }
        self._columns: dict[str, NDArray[Any]] = {
            name: np.zeros((capacity, *shapes.get(name, ())), DTYPES.get(name, np.float32))
            for name in Experiences.__dataclass_fields__
        }
        self._marked = MarkedRows(marked_capacity or capacity)
        self._added = 0
        self._rng = np.random.default_rng(seed)

    def __len__(self) -> int:
        return min(self._added, self._capacity)

    @property
    def added(self) -> int:
        """Experiences added since the beginning: the number of the next one."""
        return self._added

    @property
    def marked(self) -> int:
        """Marked rows to draw from."""
        return len(self._marked)

    def empty_batch(self, size: int) -> ReplayBatch:
        """Room for a batch; several are needed when peers are asked for the next batches ahead."""
        return ReplayBatch(size, *self._sizes)

    def add(self, experiences: Experiences) -> Rows:
        """Add k <= capacity experiences; returns their numbers [k], with which they can be marked.

        Raises:
            ValueError: if there are more than the capacity, or a column has another shape than it should.
        """
        count = len(experiences.q)
        if count > self._capacity:
            raise ValueError(f"{count} experiences for a replay of {self._capacity}: add them in parts")
        numbers = np.arange(self._added, self._added + count)
        rows = numbers % self._capacity
        for name, column in self._columns.items():
            values = getattr(experiences, name)
            if values.shape != (count, *column.shape[1:]):
                raise ValueError(f"{name}: expected shape {(count, *column.shape[1:])}, got {values.shape}")
            column[rows] = values
        self._added += count
        self._marked.forget(self._oldest)
        return numbers

    @property
    def _oldest(self) -> int:
        return max(0, self._added - self._capacity)

    def mark(self, numbers: Rows) -> None:
        """Mark experiences by number, as the steps before a success; those that are gone are left out."""
        self._marked.add(numbers[numbers >= self._oldest])

    def sample(self, batch: ReplayBatch, *, marked_share: float = 0.0) -> None:
        """Fill a batch with rows drawn uniformly with replacement, a share of them from the marked rows.

        Raises:
            ValueError: if the replay is empty.
        """
        if not self._added:
            raise ValueError("the replay is empty: add experiences before a batch is drawn")
        batch.rows[:] = self._draw(len(batch.rows), marked_share)
        self.fill(batch)

    def _draw(self, count: int, marked_share: float) -> Rows:
        rows = self._rng.integers(0, len(self), count)
        share = round(count * marked_share)
        if share and len(self._marked):
            numbers = self._marked.draw(share, self._rng)
            rows[:share] = np.where(numbers >= self._oldest, numbers % self._capacity, rows[:share])
        return rows

    def fill(self, batch: ReplayBatch) -> None:
        """Copy the rows named in ``batch.rows`` into the batch."""
        columns, rows = self._columns, batch.rows
        self._fill_states(batch.states, columns["observations"], columns["q"], rows)
        self._fill_states(batch.next_states, columns["next_observations"], columns["next_q"], rows)
        for name in ("actions", "rewards", "discounts"):
            columns[name].take(rows, axis=0, out=getattr(batch, name), mode="clip")
        batch.boundary_rows = np.flatnonzero(columns["boundary"][rows])
        peers = rows[batch.boundary_rows]
        batch.boundary_observations, batch.boundary_q = columns["next_observations"][peers], columns["next_q"][peers]

    def _fill_states(self, states: Floats, observations: Floats, q: NDArray[np.int32], rows: Rows) -> None:
        size = observations.shape[1]
        states[:, :size] = observations[rows]
        if not self._dfa_states:
            return
        states[:, size:] = 0.0
        states[np.arange(len(rows)), size + q[rows]] = 1.0

    def state(self) -> Weights:
        """Everything, for an exact resume; the columns are views of the filled part, not copies."""
        filled = {name: column[: len(self)] for name, column in self._columns.items()}
        return filled | {"added": np.array(self._added), "marked": self._marked.all(), "rng": _rng_words(self._rng)}

    def load_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from a ``state``.

        Raises:
            RunError: if it is of a replay of another capacity or other shapes.
        """
        filled = min(int(state["added"]), self._capacity)
        for name, column in self._columns.items():
            if state[name].shape != (filled, *column.shape[1:]):
                raise RunError(f"replay: {name} has shape {state[name].shape}, expected {(filled, *column.shape[1:])}")
            column[:filled] = state[name]
        self._added = int(state["added"])
        self._marked = MarkedRows(self._marked.capacity)
        self._marked.add(state["marked"])
        _set_rng_words(self._rng, state["rng"])


def _rng_words(rng: np.random.Generator) -> NDArray[np.uint64]:
    """State of a PCG64 generator as six 64-bit words."""
    state = rng.bit_generator.state
    wide = [state["state"]["state"], state["state"]["inc"]]
    words = [part for number in wide for part in (number >> 64, number & (2**64 - 1))]
    return np.array([*words, state["has_uint32"], state["uinteger"]], np.uint64)


def _set_rng_words(rng: np.random.Generator, words: NDArray[np.uint64]) -> None:
    high, low, inc_high, inc_low, has_uint32, uinteger = (int(word) for word in words)
    inner = {"state": high << 64 | low, "inc": inc_high << 64 | inc_low}
    rng.bit_generator.state = {
        "bit_generator": "PCG64", "state": inner, "has_uint32": has_uint32, "uinteger": uinteger,
    }  # fmt: skip
