"""The peers of a worker's learners: in-process directly, others over the wire."""

from __future__ import annotations

from collections import ChainMap
from functools import partial
from typing import TYPE_CHECKING

from t4nmtd_dist.agents.common.peer_values import CriticValues, LocalPeers, MixedPeers, NoPeers, PeerCritics
from t4nmtd_dist.wire.auth.keys import ClientKeys
from t4nmtd_dist.wire.peers.critic_client import QueryPeers
from t4nmtd_dist.wire.peers.experience_client import PeerExperience
from t4nmtd_dist.wire.peers.replica import ReplicaPeers
from t4nmtd_dist.wire.rate_limited_log import Log
from t4nmtd_dist.wire.zmq_types import Context

if TYPE_CHECKING:
    from t4nmtd_dist.agents.common.replay_buffer import ReplayBuffer
    from workers.learner_session import LearnerSession


class PeerRegistry:
    """Peers that this worker's learners query for values and learn experience from.

    Args:
        keys: this worker's own, if the coordinator has keys.
        tell: logs problems.

    Attributes:
        peers: each own learner's peers, by its pid.
        experience: experience pulled from other processes; None until a learner uses it.
    """

    def __init__(self, context: Context, instance: str, keys: ClientKeys | None, tell: Log = lambda text: None) -> None:
        self._context, self._instance, self._keys, self._tell = context, instance, keys, tell
        self._critics: dict[str, CriticValues] = {}
        self._lived: dict[str, ReplayBuffer] = {}
        self._remote: dict[str, QueryPeers | ReplicaPeers] = {}
        self.peers: dict[str, PeerCritics] = {}
        self.experience: PeerExperience | None = None

    def join(self, session: LearnerSession) -> None:
        """Add a learner."""
        self._critics[session.pid] = session.learner.critic_values
        self.peers[session.pid] = self._peers_of(session)
        self._share_experience(session)

    def _peers_of(self, session: LearnerSession) -> PeerCritics:
        """The learner's peers; those in this process are evaluated directly."""
        if session.intervention == "off":
            return NoPeers()
        near = LocalPeers(self._critics)
        if session.intervention == "local":
            return near
        remote = self._remote[session.pid] = self._remote_peers(session)
        return MixedPeers(self._critics, near, remote)

    def _remote_peers(self, session: LearnerSession) -> QueryPeers | ReplicaPeers:
        learner, sender = session.learner, f"{self._instance}/{session.pid}"
        if session.intervention == "replica":
            return ReplicaPeers(self._context, sender, learner.replica, self._keys)
        return QueryPeers(self._context, sender, self._keys, learner.value_shape)

    def _share_experience(self, session: LearnerSession) -> None:
        """Let a learner use all others' experience."""
        learner = session.learner
        if learner.replay_buffer is None or not learner.peer_steps:
            return
        self._lived[session.pid] = learner.replay_buffer
        if self.experience is None:
            make, sender = partial(learner.replay_buffer.alike, learner.peer_steps), f"{self._instance}/experience"
            self.experience = PeerExperience(self._context, sender, make, session.symbols, self._keys, tell=self._tell)
        learner.learn_from(ChainMap(self._lived, self.experience.copies))

    def locate(self, session: LearnerSession) -> None:
        """Update a learner's peers with their current addresses."""
        elsewhere = {pid: peer for pid, peer in session.peers.items() if pid not in self._critics}
        for asker in (self._remote.get(session.pid), self.experience):
            if asker is not None:
                asker.set_peers(elsewhere)

    def pull_experience(self) -> None:
        """Pull new experience from remote peers; never waits."""
        if self.experience is not None:
            self.experience.pull()

    def leave(self, pid: str) -> None:
        """Remove a learner."""
        for table in (self._critics, self._lived, self.peers):
            table.pop(pid, None)
        remote = self._remote.pop(pid, None)
        if remote is not None:
            remote.close()
        if not self._lived and self.experience is not None:
            self.experience.close()
            self.experience = None

    def close(self) -> None:
        """Close all connections."""
        for pid in list(self._critics):
            self.leave(pid)
