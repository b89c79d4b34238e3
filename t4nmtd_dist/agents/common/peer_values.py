"""Policy intervention: where the value of a state across a sub-task boundary comes from (paper, Algorithm 2).

A learner that leaves a DFA state hands over to a peer, so the value it bootstraps from is the peer's. There is one
interface and these ways behind it (docs/decisions/013): ``NoPeers`` (experiment 3: the learner's own critic),
``LocalPeers`` (same process), ``wire.critic_client.QueryPeers`` (ask the peer's process), ``wire.replica.ReplicaPeers``
(evaluate a copy of its networks at home), and ``MixedPeers`` (some here, the others elsewhere).
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
    """Rows of critic values since the learner began.

    Attributes:
        asked: rows that a peer was to value.
        answered: rows that were trained with the peer's value.
        late: rows asked of a peer whose answer had not come when their batch was trained.
        own_used: rows that fell back to the own critic, the late ones included; ``asked`` less ``answered``.
        lag_total: sum over answered rows of how many versions the peer was ahead of the networks that answered.
    """

    asked: int = 0
    answered: int = 0
    late: int = 0
    own_used: int = 0
    lag_total: int = 0

    def __add__(self, other: InterventionCounts) -> InterventionCounts:
        """Sums of two counts."""
        names = [each.name for each in fields(self)]
        return InterventionCounts(**{name: getattr(self, name) + getattr(other, name) for name in names})


@dataclass(frozen=True)
class Questions:
    """Product states whose values are asked, all of one batch.

    Attributes:
        rows: the asker's own numbers for them, no number twice in a batch [k].
        pids: whose value of each is wanted [k].
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
        """The questions of every peer."""
        names = set(self.pids)
        if len(names) == 1:
            return {self.pids[0]: self}
        column = np.array(self.pids)
        return {pid: self._part(np.flatnonzero(column == pid), pid) for pid in sorted(names)}

    def _part(self, chosen: RowNumbers, pid: str) -> Questions:
        return Questions(self.rows[chosen], (pid,) * len(chosen), self.observations[chosen], self.q[chosen])


@dataclass(frozen=True)
class PeerValues:
    """Answers: ``values[i]`` belongs to row ``rows[i]`` of what was asked; rows without an answer are absent.

    A value is a number (PPO: V), or a pair (SAC: min of the target critics, log pi).
    """

    rows: RowNumbers
    values: Values

    @classmethod
    def joined(cls, answers: list[PeerValues]) -> PeerValues:
        """Answers one after the other; float32 [0] values if there are none."""
        if len(answers) == 1:
            return answers[0]
        if not answers:
            return cls(np.empty(0, np.int64), np.empty(0, np.float32))
        return cls(np.concatenate([a.rows for a in answers]), np.concatenate([a.values for a in answers]))


class PeerCritics(Protocol):
    """Asked for the values of numbered batches ahead of their training, and for all answers to one when it is trained.

    The loop it is meant for::

        for step in rollout:
            peers.ask(batch, questions)  # may be repeated, and for several batches ahead
        answers = peers.gather(batch)
    """

    @property
    def counts(self) -> InterventionCounts:
        """Rows since the learner began."""

    def ask(self, batch: int, questions: Questions) -> None:
        """Ask for values that belong to batch number ``batch``; never waits."""

    def gather(self, batch: int, patience_s: float = 0.0) -> PeerValues:
        """The answers to what was asked for ``batch``, once: what has not come within ``patience_s`` never will."""


class NoPeers:
    """``intervention=off``: nobody is asked, so every boundary is bootstrapped with the learner's own critic."""

    def __init__(self) -> None:
        self.counts = InterventionCounts()

    def ask(self, batch: int, questions: Questions) -> None:
        """Do nothing."""

    def gather(self, batch: int, patience_s: float = 0.0) -> PeerValues:
        """No answers."""
        return PeerValues.joined([])


class LocalPeers:
    """Peers in the same process, evaluated directly when a batch is gathered: no lag.

    Args:
        critics: by pid, a function from observations [k, d] and DFA states [k] to values [k]. It is looked into anew
            at every gathering; rows of a pid that it lacks stay without an answer.
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
    """All questions of every peer as one; of a peer in the order in which they were asked."""
    if not asked:
        return {}
    rows, q = np.concatenate([each.rows for each in asked]), np.concatenate([each.q for each in asked])
    pids = tuple(pid for each in asked for pid in each.pids)
    return Questions(rows, pids, np.concatenate([each.observations for each in asked]), q).by_pid()


@dataclass(frozen=True)
class MixedPeers:
    """Some peers in this process, the others elsewhere.

    Attributes:
        here: the pids that ``near`` answers for; looked into anew at every question.
        near: peers in this process.
        far: all others.
    """

    here: Container[str]
    near: PeerCritics
    far: PeerCritics

    @property
    def counts(self) -> InterventionCounts:
        """Rows of both kinds of peers."""
        return self.near.counts + self.far.counts

    def ask(self, batch: int, questions: Questions) -> None:
        """See ``PeerCritics.ask``."""
        for pid, part in questions.by_pid().items():
            (self.near if pid in self.here else self.far).ask(batch, part)

    def gather(self, batch: int, patience_s: float = 0.0) -> PeerValues:
        """See ``PeerCritics.gather``."""
        found = [self.near.gather(batch), self.far.gather(batch, patience_s)]
        return PeerValues.joined([answers for answers in found if len(answers.rows)])
