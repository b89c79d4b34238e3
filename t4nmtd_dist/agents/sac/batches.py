"""The batches that a SAC learner trains on: own experience, and that of its peers, read for the own sub-task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.normalisation import Normalisation
from t4nmtd_dist.agents.common.peer_success_replay import ChanceFinds, target_symbols
from t4nmtd_dist.agents.common.peer_values import Questions, RowNumbers
from t4nmtd_dist.agents.common.replay_buffer import Experience
from t4nmtd_dist.agents.common.successors import draw_successors
from t4nmtd_dist.agents.sac.config import SACConfig
from t4nmtd_dist.agents.sac.interface import SACBatch
from t4nmtd_dist.core.config import LearnerConfig
from t4nmtd_dist.environments.batched import Observations
from t4nmtd_dist.method.protocol import Method

Floats = NDArray[np.float32]
States = NDArray[np.int32]


def product_states(observations: Observations, q: States, states: int) -> Floats:
    """What networks see, [N, d + |Q|]: observations [N, d], and DFA states [N] one-hot."""
    size = observations.shape[1]
    joined = np.zeros((len(observations), size + states), np.float32)
    joined[:, :size] = observations
    joined[np.arange(len(observations)), size + q] = 1.0
    return joined


@dataclass(frozen=True)
class _Reading:
    """Experiences read for the own sub-task; the columns of a batch."""

    states: Floats
    actions: Floats
    rewards: Floats
    discounts: Floats
    next_states: Floats
    q_next: States
    boundary: NDArray[np.bool_]

    @classmethod
    def joined(cls, parts: Sequence[_Reading]) -> _Reading:
        """One after the other."""
        if len(parts) == 1:
            return parts[0]
        return cls(*(np.concatenate(columns) for columns in zip(*(vars(part).values() for part in parts), strict=True)))


@dataclass(frozen=True)
class DrawnBatch:
    """A batch between its drawing and its training, as plain data; B rows, k of them across a boundary.

    Attributes:
        number: gradient steps that come before it.
        states: product states [B, d + |Q|], observations as the environment gave them.
        actions: [B, A].
        rewards: scaled n-step returns [B].
        discounts: [B].
        next_states: product states that are bootstrapped from [B, d + |Q|].
        asked_rows: rows whose value is a peer's [k].
        asked_pids: of which peer [k].
        asked_q: DFA states of these rows' next states [k].
    """

    number: int
    states: Floats
    actions: Floats
    rewards: Floats
    discounts: Floats
    next_states: Floats
    asked_rows: RowNumbers
    asked_pids: tuple[str, ...]
    asked_q: States

    def questions(self, observation_size: int) -> Questions:
        """What peers are asked about it; observations are the first ``observation_size`` numbers of a state."""
        observations = self.next_states[self.asked_rows, :observation_size]
        return Questions(self.asked_rows, self.asked_pids, observations, self.asked_q)

    def tensors(self, normalisation: Normalisation | None = None) -> SACBatch:
        """What the gradient step learns from, with observations as it is to see them."""
        states, next_states = self.states, self.next_states
        if normalisation is not None:
            states, next_states = map(normalisation.apply_to_states, (states, next_states))
        columns = (states, self.actions, self.rewards, self.discounts, next_states)
        return SACBatch(*map(torch.from_numpy, columns))


class BatchSource:
    """Draws batches for one sub-task.

    Args:
        pid: the sub-task.
        experience: the learner's own.
        delta: the DFA's transition table, int32 [Q, symbols].
        config: settings shared by all learners.
        sac: settings of SAC.
        method: says which rows are read in which DFA states, and whose value they bootstrap from.
        rng: the learner's generator.

    Attributes:
        others: the experience of peers by pid; it may hold the own.
        tables: of the sub-task.
        method: as given.
        reads_peers: whether peers' experience is of use.
    """

    def __init__(
        self,
        pid: str,
        experience: Experience,
        delta: NDArray[np.int32],
        config: LearnerConfig,
        sac: SACConfig,
        method: Method,
        rng: np.random.Generator,
    ) -> None:
        self._pid, self._experience, self.method, self._rng = pid, experience, method, rng
        self.tables, self._delta, self._config, self._sac = method.role(pid).tables, delta, config, sac
        reading = method.reads(pid)
        self._readable = reading.q
        self.reads_peers = reading.rows == "all" and sac.peer_share > 0
        self._finds = WeakKeyDictionary[Experience, ChanceFinds]()
        self.others: Mapping[str, Experience] = {}

    def peers_experience(self) -> list[Experience]:
        """What is not empty, and there is use for."""
        if not self.reads_peers:
            return []
        return [experience for pid, experience in self.others.items() if pid != self._pid and len(experience)]

    def draw(self, number: int, success: float) -> DrawnBatch:
        """A batch, a share of it from the experience of one peer, which is as likely as its experience is long.

        Args:
            number: of the batch.
            success: share of the own recent attempts that succeeded.
        """
        sac, parts = self._sac, []
        others = self.peers_experience()
        peers_rows = round(sac.batch * sac.peer_share) if others else 0
        if peers_rows < sac.batch:
            parts.append(self._own_rows(sac.batch - peers_rows))
        if peers_rows:
            parts.append(self._peers_rows(others, peers_rows, success))
        read = _Reading.joined(parts)
        successors = draw_successors(self.method, self._pid, read.boundary, read.q_next, self._rng)
        read.discounts[successors.without_value] = 0.0
        return DrawnBatch(
            number=number,
            states=read.states,
            actions=read.actions,
            rewards=read.rewards,
            discounts=read.discounts,
            next_states=read.next_states,
            asked_rows=successors.rows,
            asked_pids=successors.pids,
            asked_q=read.q_next[successors.rows],
        )

    def _own_rows(self, size: int) -> _Reading:
        """Own experience, each row read in its own DFA state or in one drawn from all of the sub-task's."""
        sac, experience = self._sac, self._experience
        rows = experience.sample(size, sac.success_share, self._rng)
        q = experience.q[rows]
        if sac.relabel_share and len(self._readable) > 1:
            q = np.where(self._rng.random(size) < sac.relabel_share, self._any_state(size), q)
        return self._read(experience, rows, q)

    def _peers_rows(self, others: Sequence[Experience], size: int, success: float) -> _Reading:
        """A peer's experience, read in DFA states of the own sub-task: those in which the peer was may not be any.

        A learner that fails also draws from what its peer found by chance, as it draws from before own successes.
        """
        lengths = np.array([len(experience) for experience in others])
        experience = others[int(self._rng.choice(len(others), p=lengths / lengths.sum()))]
        rows = experience.sample(size, 0.0, self._rng)
        wanted = round(size * self._sac.success_share * (1.0 - success) ** 2)
        if wanted and len(finds := self._finds_in(experience)):
            rows[:wanted] = finds[self._rng.integers(len(finds), size=wanted)]
        return self._read(experience, rows, self._any_state(size))

    def _finds_in(self, experience: Experience) -> RowNumbers:
        finds = self._finds.get(experience)
        if finds is None:
            finds = ChanceFinds(target_symbols(self.tables, self._delta))
            self._finds[experience] = finds
        return finds.rows(experience)

    def _any_state(self, size: int) -> States:
        return self._readable[self._rng.integers(len(self._readable), size=size)]

    def _read(self, experience: Experience, rows: RowNumbers, q: States) -> _Reading:
        returns = experience.returns(rows, q, self.tables, self._delta, self._config.gamma, self._sac.n_step)
        states = len(self._delta)
        return _Reading(
            states=product_states(experience.observations[rows], q, states),
            actions=experience.actions[rows],
            rewards=(returns.reward * self._config.reward_scale).astype(np.float32),
            discounts=returns.discount.astype(np.float32),
            next_states=product_states(experience.next_observations[returns.last], returns.q_next, states),
            q_next=returns.q_next.astype(np.int32),
            boundary=returns.boundary,
        )
