"""Replicas of peers' networks, pulled by version and evaluated locally (``intervention=replica``)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from t4nmtd_dist.agents.common.peer_values import InterventionCounts, PeerValues, Questions, together
from t4nmtd_dist.core.errors import PolicyError, ProtocolError
from t4nmtd_dist.wire.auth.keys import ClientKeys
from t4nmtd_dist.wire.codec import without_prefix
from t4nmtd_dist.wire.messages import Peer, WeightsReply, WeightsRequest
from t4nmtd_dist.wire.peers.peer_connections import PeerClient, arrived
from t4nmtd_dist.wire.zmq_types import Context, Socket

if TYPE_CHECKING:
    from t4nmtd_dist.agents.protocol import PublishedValues

NO_VERSION = -1
PULL_EVERY_S = 2.0
FIRST_PULL_EVERY_S = 0.25


@dataclass
class _PeerConnection:
    """The connection to one peer and the replica of its networks.

    Attributes:
        copy: the replica; None until weights have arrived.
        version: of the replica.
        epoch: the peer's lease epoch at the pull; versions may restart under another.
        pull_at: when to request newer weights.
    """

    peer: Peer
    socket: Socket
    copy: PublishedValues | None = None
    version: int = NO_VERSION
    epoch: int = 0
    pull_at: float = 0.0


@dataclass
class _Batch:
    """A batch of questions not yet gathered.

    Attributes:
        asked: rows requested.
        waiting: questions not yet evaluated.
        answers: values with the lag of their versions.
    """

    asked: int = 0
    waiting: list[Questions] = field(default_factory=list)
    answers: list[tuple[PeerValues, int]] = field(default_factory=list)


class ReplicaPeers(PeerClient[_PeerConnection]):
    """Peers in other processes whose networks are evaluated here.

    A peer's weights are pulled only while its values are requested, at most every two seconds (every 0.25 s before the
    first), and only if the coordinator knows a newer version. Gathering a batch evaluates all open batches in one call
    per peer. Rows of a peer without weights fall back to the learner's own critic.

    Args:
        make: creates a network to load peers' weights into.
        keys: this worker's own, if the coordinator has keys.
        clock: monotonic, in seconds.
    """

    def __init__(
        self,
        context: Context,
        sender: str,
        make: Callable[[], PublishedValues],
        keys: ClientKeys | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(context, sender, keys, _PeerConnection, clock)
        self._make = make
        self._batches: dict[int, _Batch] = {}
        self.counts = InterventionCounts()

    def ask(self, batch: int, questions: Questions) -> None:
        """See ``PeerCritics.ask``."""
        self.counts.asked += len(questions)
        opened = self._batches.setdefault(batch, _Batch())
        opened.asked += len(questions)
        opened.waiting.append(questions)
        for pid in set(questions.pids):
            connection = self._connections.by_pid.get(pid)
            if connection is not None:
                self._keep_fresh(pid, connection)

    def _keep_fresh(self, pid: str, connection: _PeerConnection) -> None:
        if self._clock() < connection.pull_at:
            return
        known = connection.version if connection.epoch == connection.peer.epoch else NO_VERSION
        if connection.copy is None or connection.peer.version > known:
            self._send(connection, WeightsRequest(pid=pid, newer_than=known))
        connection.pull_at = self._clock() + (FIRST_PULL_EVERY_S if connection.copy is None else PULL_EVERY_S)

    def _take(self, connection: _PeerConnection) -> None:
        """Load arrived weights, if usable."""
        for envelope in arrived(connection.socket):
            weights = without_prefix("weights.", envelope.arrays)
            if not isinstance(envelope.message, WeightsReply) or not weights:
                continue
            copy = connection.copy or self._make()
            try:
                copy.load(weights, envelope.message.version)
            except (PolicyError, ProtocolError):
                connection.copy = None
                continue
            connection.copy, connection.version, connection.epoch = (
                copy,
                envelope.message.version,
                connection.peer.epoch,
            )

    def gather(self, batch: int, patience_s: float = 0.0) -> PeerValues:
        """See ``PeerCritics.gather``; never waits."""
        gathered = self._batches.get(batch)
        if gathered is None:
            return PeerValues.joined([])
        if gathered.waiting:
            self._evaluate_all()
        del self._batches[batch]
        return self._close(gathered)

    def _evaluate_all(self) -> None:
        """Evaluate all waiting questions, in one call per peer with weights."""
        waiting: dict[str, list[tuple[_Batch, Questions]]] = {}
        for batch in self._batches.values():
            for pid, part in together(batch.waiting).items():
                waiting.setdefault(pid, []).append((batch, part))
            batch.waiting = []
        for pid, parts in waiting.items():
            connection = self._connections.by_pid.get(pid)
            if connection is not None:
                self._take(connection)
            if connection is not None and connection.copy is not None:
                self._evaluate(pid, connection, connection.copy, parts)
                continue
            for batch, part in parts:
                batch.waiting.append(part)

    def _evaluate(
        self, pid: str, connection: _PeerConnection, copy: PublishedValues, parts: list[tuple[_Batch, Questions]]
    ) -> None:
        asked = together([part for _, part in parts])[pid]
        values, version = copy.values({"observation": asked.observations, "q": np.asarray(asked.q, np.int32)})
        lag, begin, good = max(0, connection.peer.version - version), 0, bool(np.isfinite(values).all())
        for batch, part in parts:
            end = begin + len(part)
            if good:
                batch.answers.append((PeerValues(part.rows, values[begin:end]), lag))
            begin = end

    def _close(self, gathered: _Batch) -> PeerValues:
        found = PeerValues.joined([answers for answers, _ in gathered.answers])
        self.counts.answered += len(found.rows)
        self.counts.own_used += gathered.asked - len(found.rows)
        self.counts.lag_total += sum(lag * len(answers.rows) for answers, lag in gathered.answers)
        lines = self._connections.by_pid
        self.counts.late += sum(pid in lines for each in gathered.waiting for pid in each.pids)
        return found
