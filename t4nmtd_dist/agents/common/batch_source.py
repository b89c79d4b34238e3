"""Draws an off-policy agent's batches from own and peers' replay, relabelled for its sub-task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.batches import DrawnBatch
from t4nmtd_dist.agents.common.off_policy_config import OffPolicyConfig
from t4nmtd_dist.agents.common.peer_success_replay import PeerSuccesses, target_symbols
from t4nmtd_dist.agents.common.peer_values import RowNumbers
from t4nmtd_dist.agents.common.relabelling import ExperienceReader, Reading
from t4nmtd_dist.agents.common.replay_buffer import ReplayBuffer
from t4nmtd_dist.agents.common.successors import draw_successors
from t4nmtd_dist.method.protocol import Method

States = NDArray[np.int32]


class BatchSource:
    """Draws batches for one sub-task.

    Args:
        experience: the learner's own replay buffer.
        config: shares of a batch.
        method: selects the DFA states to read rows in, and the bootstrap peer.

    Attributes:
        others: peers' replay buffers by pid; may include the own one.
        reads_peers: whether peers' replay is used.
    """

    def __init__(
        self,
        pid: str,
        experience: ReplayBuffer,
        reader: ExperienceReader,
        config: OffPolicyConfig,
        method: Method,
        rng: np.random.Generator,
    ) -> None:
        self._pid, self._experience, self.method, self._rng = pid, experience, method, rng
        self.reader, self._config = reader, config
        reading = method.reads(pid)
        self._readable = reading.q
        self.reads_peers = reading.rows == "all" and config.peer_share > 0
        self._peer_successes = WeakKeyDictionary[ReplayBuffer, PeerSuccesses]()
        self.others: Mapping[str, ReplayBuffer] = {}

    def peers_experience(self) -> list[ReplayBuffer]:
        """Peers' non-empty replay buffers; none if peers' replay is not used."""
        if not self.reads_peers:
            return []
        return [experience for pid, experience in self.others.items() if pid != self._pid and len(experience)]

    def draw(self, number: int, success: float) -> DrawnBatch:
        """Draw batch ``number``; its peer share comes from one peer, drawn in proportion to buffer length."""
        config, parts = self._config, []
        others = self.peers_experience()
        peers_rows = round(config.batch * config.peer_share) if others else 0
        if peers_rows < config.batch:
            parts.append(self._own_rows(config.batch - peers_rows))
        if peers_rows:
            parts.append(self._peers_rows(others, peers_rows, success))
        read = Reading.joined(parts)
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

    def _own_rows(self, size: int) -> Reading:
        """Own rows, read in their own or another DFA state of the sub-task."""
        config, experience = self._config, self._experience
        rows = experience.sample(size, config.success_share, self._rng)
        q = experience.q[rows]
        if config.relabel_share and len(self._readable) > 1:
            q = np.where(self._rng.random(size) < config.relabel_share, self._any_state(size), q)
        return self.reader.read(experience, rows, q)

    def _peers_rows(self, others: Sequence[ReplayBuffer], size: int, success: float) -> Reading:
        """A peer's rows, read in DFA states of the own sub-task.

        The lower the success rate, the more of them come from before accidental successes.
        """
        lengths = np.array([len(experience) for experience in others])
        experience = others[int(self._rng.choice(len(others), p=lengths / lengths.sum()))]
        rows = experience.sample(size, 0.0, self._rng)
        wanted = round(size * self._config.success_share * (1.0 - success) ** 2)
        if wanted and len(finds := self._successes_of(experience)):
            rows[:wanted] = finds[self._rng.integers(len(finds), size=wanted)]
        return self.reader.read(experience, rows, self._any_state(size))

    def _successes_of(self, experience: ReplayBuffer) -> RowNumbers:
        finds = self._peer_successes.get(experience)
        if finds is None:
            finds = PeerSuccesses(target_symbols(self.reader.tables, self.reader.delta))
            self._peer_successes[experience] = finds
        return finds.rows(experience)

    def _any_state(self, size: int) -> States:
        return self._readable[self._rng.integers(len(self._readable), size=size)]
