"""Queries critic values from peers in other processes (``intervention=query``)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from t4nmtd_dist.agents.common.peer_values import InterventionCounts, PeerValues, Questions, Values, together
from t4nmtd_dist.wire.auth.keys import ClientKeys
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import Peer, ValueReply, ValueRequest
from t4nmtd_dist.wire.peers.peer_connections import PeerClient, arrived
from t4nmtd_dist.wire.zmq_types import Context, Socket

ROWS_PER_REQUEST = 128
GATHERINGS_PER_REQUEST = 8
MISSES_UNTIL_PROBING = 3
PROBE_EVERY_S = 0.5


@dataclass
class _Batch:
    """A batch of questions, open until it is gathered.

    Attributes:
        asked: rows requested.
        outstanding: rows sent and unanswered.
        answers: values with their peer and weights' version.
    """

    asked: int = 0
    outstanding: int = 0
    answers: list[tuple[PeerValues, str, int]] = field(default_factory=list)
    closed: bool = False


@dataclass(frozen=True)
class _Part:
    """One batch's questions to one peer."""

    batch: _Batch
    questions: Questions


@dataclass
class _PeerConnection:
    """The connection to one peer.

    Attributes:
        unsent: questions for the next request.
        waited: gatherings since the last request.
        in_flight: questions by request number.
        misses: consecutive late requests.
        probe_at: when to retry a silent peer.
    """

    peer: Peer
    socket: Socket
    unsent: list[_Part] = field(default_factory=list)
    waited: int = 0
    in_flight: dict[int, list[_Part]] = field(default_factory=dict)
    misses: int = 0
    probe_at: float = 0.0

    @property
    def silent(self) -> bool:
        """Whether nothing waits for it after too many misses."""
        return self.misses >= MISSES_UNTIL_PROBING

    def rows_of(self, batch: _Batch) -> int:
        """Unsent rows of ``batch``."""
        return sum(len(part.questions) for part in self.unsent if part.batch is batch)

    def is_due(self, gathered: _Batch) -> bool:
        """Whether to send now instead of collecting more questions."""
        self.waited += 1
        return self.waited >= GATHERINGS_PER_REQUEST or any(part.batch is gathered for part in self.unsent)


class QueryPeers(PeerClient[_PeerConnection]):
    """Peers in other processes: requests go out ahead of training, answers are gathered with the batch.

    Consecutive batches share a request. It is sent once one batch has ``ROWS_PER_REQUEST`` rows, after
    ``GATHERINGS_PER_REQUEST`` gatherings, or when one of its batches is gathered. Unanswered rows cost at most the
    gatherer's patience and fall back to the learner's own critic. After three consecutive misses the client stops
    waiting for a peer and queries it at most every half second until it answers.

    Args:
        keys: this worker's own, if the coordinator has keys.
        value_shape: shape of one answer: () for PPO, (2,) for SAC; others are rejected.
        clock: monotonic, in seconds.
    """

    def __init__(
        self,
        context: Context,
        sender: str,
        keys: ClientKeys | None = None,
        value_shape: tuple[int, ...] = (),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(context, sender, keys, _PeerConnection, clock)
        self._value_shape = value_shape
        self._batches: dict[int, _Batch] = {}
        self.counts = InterventionCounts()

    def ask(self, batch: int, questions: Questions) -> None:
        """See ``PeerCritics.ask``."""
        self.counts.asked += len(questions)
        opened = self._batches.setdefault(batch, _Batch())
        opened.asked += len(questions)
        for pid, part in questions.by_pid().items():
            connection = self._connections.by_pid.get(pid)
            if connection is None:
                continue
            connection.unsent.append(_Part(opened, part))
            if connection.rows_of(opened) >= ROWS_PER_REQUEST:
                self._request(pid, connection)

    def _request(self, pid: str, connection: _PeerConnection) -> None:
        parts = [part for part in connection.unsent if not part.batch.closed]
        connection.unsent, connection.waited = [], 0
        if not parts or (connection.silent and self._clock() < connection.probe_at):
            return
        connection.probe_at = self._clock() + PROBE_EVERY_S
        asked = together([part.questions for part in parts])[pid]
        arrays = {"observation": asked.observations, "q": np.asarray(asked.q, np.int32)}
        number = self._send(connection, ValueRequest(pid=pid), arrays)
        if number:
            connection.in_flight[number] = parts
            for part in parts:
                part.batch.outstanding += len(part.questions)

    def gather(self, batch: int, patience_s: float = 0.0) -> PeerValues:
        """See ``PeerCritics.gather``."""
        gathered = self._batches.pop(batch, None) or _Batch()
        for pid, connection in self._connections.by_pid.items():
            if connection.unsent and connection.is_due(gathered):
                self._request(pid, connection)
        if not gathered.asked:
            return PeerValues.joined([])
        deadline = self._clock() + patience_s
        for pid, connection in self._connections.by_pid.items():
            if connection.in_flight:
                self._drain(pid, connection, gathered, deadline)
        return self._close(gathered)

    def _drain(self, pid: str, connection: _PeerConnection, gathered: _Batch, deadline: float) -> None:
        """Read arrived answers; wait for those ``gathered`` still needs."""
        while True:
            lacking = any(part.batch is gathered for parts in connection.in_flight.values() for part in parts)
            patience_s = max(0.0, deadline - self._clock()) if lacking and not connection.silent else 0.0
            envelopes = list(arrived(connection.socket, patience_s))
            for envelope in envelopes:
                self._take(pid, connection, envelope)
            if not envelopes:
                return

    def _take(self, pid: str, connection: _PeerConnection, envelope: Envelope) -> None:
        parts = connection.in_flight.pop(envelope.id, None)
        if parts is None:
            # a late answer: the peer is back, so wait for it again
            connection.misses = min(connection.misses, MISSES_UNTIL_PROBING - 1)
            return
        connection.misses = 0
        rows = sum(len(part.questions) for part in parts)
        values = self._values(envelope, rows)
        version = envelope.message.version if isinstance(envelope.message, ValueReply) else 0
        begin = 0
        for part in parts:
            end = begin + len(part.questions)
            part.batch.outstanding -= len(part.questions)
            if values is not None:
                part.batch.answers.append((PeerValues(part.questions.rows, values[begin:end]), pid, version))
            begin = end

    def _values(self, envelope: Envelope, rows: int) -> Values | None:
        """An answer's values; None if invalid."""
        values = envelope.arrays.get("value")
        if not isinstance(envelope.message, ValueReply) or values is None:
            return None
        right = values.shape == (rows, *self._value_shape) and values.dtype == np.float32
        return values if right and np.isfinite(values).all() else None

    def _close(self, gathered: _Batch) -> PeerValues:
        gathered.closed = True
        found = PeerValues.joined([answers for answers, _, _ in gathered.answers])
        self.counts.answered += len(found.rows)
        self.counts.late += gathered.outstanding
        self.counts.own_used += gathered.asked - len(found.rows)
        for answers, pid, version in gathered.answers:
            connection = self._connections.by_pid.get(pid)
            if connection is not None:
                self.counts.lag_total += max(0, connection.peer.version - version) * len(answers.rows)
        if gathered.outstanding:
            self._forget_missed()
        return found

    def _forget_missed(self) -> None:
        for connection in self._connections.by_pid.values():
            missed = [n for n, parts in connection.in_flight.items() if all(part.batch.closed for part in parts)]
            for number in missed:
                del connection.in_flight[number]
            connection.misses += len(missed)
