"""Policy intervention: the source of a value across a sub-task boundary (paper, Algorithm 2).

A learner that leaves a DFA state hands over to a peer and bootstraps from its value. Implementations
(docs/decisions/013): ``NoPeers`` (experiment 3: own critic), ``LocalPeers`` (same process),
``wire.critic_client.QueryPeers`` (query the peer's process), ``wire.replica.ReplicaPeers`` (local copy of its
networks), and ``MixedPeers`` (some local, others remote).
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.environments.batched import Observations

Values = NDArray[np.float32]
CriticValues = Callable[[Observations, NDArray[np.int32]], Values]
RowNumbers = NDArray[np.int64]


@dataclass
class InterventionCounts:
    """Counts of critic values since the learner began.

    Attributes:
        asked: rows queried from peers.
        answered: rows trained with the peer's value.
        late: rows without an answer at their update.
        own_used: rows that fell back to the own critic, late ones included; ``asked`` minus ``answered``.
        lag_total: sum over answered rows of the versions that the answering networks were behind the peer.
    """

    asked: int = 0
    answered: int = 0
    late: int = 0
    own_used: int = 0
    lag_total: int = 0

    def __add__(self, other: InterventionCounts) -> InterventionCounts:
        """Sum two counts."""
        names = [each.name for each in fields(self)]
        return InterventionCounts(**{name: getattr(self, name) + getattr(other, name) for name in names})


@dataclass(frozen=True)
class Questions:
    """Value queries of one batch.

    Attributes:
        rows: row numbers chosen by the caller, unique within a batch [k].
        pids: peer to query for each row [k].
        observations: float32 [k, d].
        q: DFA states, int32 [k].
    """

    rows: RowNumbers
    pids: tuple[str, ...]
    observations: Observations
    q: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.rows)

    def by_pid(self) -> dict[str, Questions]:
        """The queries, split by peer."""
        names = set(self.pids)
        if len(names) == 1:
            return {self.pids[0]: self}
        column = np.array(self.pids)
        return {pid: self._part(np.flatnonzero(column == pid), pid) for pid in sorted(names)}

    def _part(self, chosen: RowNumbers, pid: str) -> Questions:
        return Questions(self.rows[chosen], (pid,) * len(chosen), self.observations[chosen], self.q[chosen])


@dataclass(frozen=True)
class PeerValues:
    """Answers: ``values[i]`` belongs to query row ``rows[i]``; unanswered rows are absent.

    A value is a number (PPO: V), or a pair (SAC: min of the target critics, log pi).
    """

    rows: RowNumbers
    values: Values

    @classmethod
    def joined(cls, answers: list[PeerValues]) -> PeerValues:
        """Concatenate answers; values are float32 [0] if there are none."""
        if len(answers) == 1:
            return answers[0]
        if not answers:
            return cls(np.empty(0, np.int64), np.empty(0, np.float32))
        return cls(np.concatenate([a.rows for a in answers]), np.concatenate([a.values for a in answers]))


class PeerCritics(Protocol):
    """Queried about numbered batches ahead of their updates.

    Intended loop::

        for step in rollout:
            peers.ask(batch, questions)  # may be repeated, and for several batches ahead
        answers = peers.gather(batch)
    """

    @property
    def counts(self) -> InterventionCounts:
        """Counts since the learner began."""

    def ask(self, batch: int, questions: Questions) -> None:
        """Query values for batch number ``batch``; never blocks."""

    def gather(self, batch: int, patience_s: float = 0.0) -> PeerValues:
        """The answers for ``batch``; call once. Answers not received within ``patience_s`` are lost."""


class NoPeers:
    """``intervention=off``: queries nobody, so every boundary bootstraps from the own critic."""

    def __init__(self) -> None:
        self.counts = InterventionCounts()

    def ask(self, batch: int, questions: Questions) -> None:
        """Do nothing."""

    def gather(self, batch: int, patience_s: float = 0.0) -> PeerValues:
        """No answers."""
        return PeerValues.joined([])


class LocalPeers:
    """Peers in the same process, evaluated when a batch is gathered: no lag.

    Args:
        critics: functions from observations [k, d] and DFA states [k] to values [k], by pid; read at every ``gather``.
            Rows of a missing pid stay unanswered.
    """

    def __init__(self, critics: Mapping[str, CriticValues]) -> None:
        self._critics = critics
        self._asked: dict[int, list[Questions]] = {}
        self.counts = InterventionCounts()

    def ask(self, batch: int, questions: Questions) -> None:
        """See ``PeerCritics.ask``."""
        self._asked.setdefault(batch, []).append(questions)
        self.counts.asked += len(questions)

    def gather(self, batch: int, patience_s: float = 0.0) -> PeerValues:
        """See ``PeerCritics.gather``."""
        asked = self._asked.pop(batch, [])
        answers = [
            PeerValues(part.rows, self._critics[pid](part.observations, part.q))
            for pid, part in together(asked).items()
            if pid in self._critics
        ]
        found = PeerValues.joined(answers)
        self.counts.answered += len(found.rows)
        self.counts.own_used += sum(map(len, asked)) - len(found.rows)
        return found


def together(asked: list[Questions]) -> dict[str, Questions]:
    """Merge the queries by peer, keeping their order."""
    if not asked:
        return {}
    rows, q = np.concatenate([each.rows for each in asked]), np.concatenate([each.q for each in asked])
    pids = tuple(pid for each in asked for pid in each.pids)
    return Questions(rows, pids, np.concatenate([each.observations for each in asked]), q).by_pid()


@dataclass(frozen=True)
class MixedPeers:
    """Some peers in this process, the others in other processes.

    Attributes:
        here: pids that ``near`` answers for; checked at every query.
        near: peers in this process.
        far: all others.
    """

    here: Container[str]
    near: PeerCritics
    far: PeerCritics

    @property
    def counts(self) -> InterventionCounts:
        """Sum of both kinds' counts."""
        return self.near.counts + self.far.counts

    def ask(self, batch: int, questions: Questions) -> None:
        """See ``PeerCritics.ask``."""
        for pid, part in questions.by_pid().items():
            (self.near if pid in self.here else self.far).ask(batch, part)

    def gather(self, batch: int, patience_s: float = 0.0) -> PeerValues:
        """See ``PeerCritics.gather``."""
        found = [self.near.gather(batch), self.far.gather(batch, patience_s)]
        return PeerValues.joined([answers for answers in found if len(answers.rows)])
