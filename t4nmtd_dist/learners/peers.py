"""Policy intervention: where the value of a state across a sub-task boundary comes from (paper, Algorithm 2).

A learner that leaves a DFA state hands over to a peer, so the value it bootstraps from is the peer's. There is one
interface and two ways here: ``NoPeers`` (experiment 3: the learner's own critic) and ``LocalPeers`` (same process).
Asking another process is ``wire.critic_client.QueryPeers``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.worlds import Observations

Values = NDArray[np.float32]
CriticValues = Callable[[Observations, NDArray[np.int32]], Values]


@dataclass
class InterventionCounts:
    """Rows of critic values since the learner began; ``own_used`` counts rows that fell back to the own critic."""

    asked: int = 0
    answered: int = 0
    late: int = 0
    own_used: int = 0
    lag_total: int = 0


@dataclass(frozen=True)
class PeerValues:
    """Answers: ``values[i]`` belongs to row ``rows[i]`` of what was asked; rows without an answer are absent.

    A value is a number (PPO: V), or a pair (SAC: min of the target critics, log pi).
    """

    rows: NDArray[np.int64]
    values: Values


def joined(values: list[Values]) -> Values:
    """Answers one after the other; float32 [0] if there are none."""
    return np.concatenate(values) if values else np.empty(0, np.float32)


class PeerCritics(Protocol):
    """Asked for values while a roll-out goes on, and for all answers when it is trained.

    The loop it is meant for::

        for step in rollout:
            peers.ask(row, pid, observation, q)
        answers = peers.gather()
    """

    counts: InterventionCounts

    def ask(self, row: int, pid: str, observation: NDArray[np.float32], q: int) -> None:
        """Ask peer ``pid`` for the value of <observation, q>; ``row`` is the asker's own number for it."""

    def gather(self) -> PeerValues:
        """All answers to what was asked since the last call; waits no longer than a short deadline."""


class NoPeers:
    """``intervention=off``: nobody is asked, so every boundary is bootstrapped with the learner's own critic."""

    def __init__(self) -> None:
        self.counts = InterventionCounts()

    def ask(self, row: int, pid: str, observation: NDArray[np.float32], q: int) -> None:
        """Do nothing."""

    def gather(self) -> PeerValues:
        """No answers."""
        return PeerValues(np.empty(0, np.int64), np.empty(0, np.float32))


class LocalPeers:
    """Peers in the same process, evaluated directly: no lag.

    Args:
        critics: by pid, a function from observations [k, d] and DFA states [k] to values [k].
    """

    def __init__(self, critics: Mapping[str, CriticValues]) -> None:
        self._critics = critics
        self._asked: dict[str, list[tuple[int, NDArray[np.float32], int]]] = {}
        self.counts = InterventionCounts()

    def ask(self, row: int, pid: str, observation: NDArray[np.float32], q: int) -> None:
        """See ``PeerCritics.ask``."""
        self._asked.setdefault(pid, []).append((row, observation, q))
        self.counts.asked += 1

    def gather(self) -> PeerValues:
        """See ``PeerCritics.gather``."""
        asked, self._asked = self._asked, {}
        rows = [row for questions in asked.values() for row, _, _ in questions]
        values = [self._evaluate(pid, questions) for pid, questions in asked.items()]
        self.counts.answered += len(rows)
        return PeerValues(np.array(rows, np.int64), joined(values))

    def _evaluate(self, pid: str, questions: list[tuple[int, NDArray[np.float32], int]]) -> Values:
        observations = np.stack([observation for _, observation, _ in questions])
        return self._critics[pid](observations, np.array([q for _, _, q in questions], np.int32))
