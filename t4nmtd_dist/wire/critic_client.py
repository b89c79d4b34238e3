"""Asking peers' processes for critic values (``intervention=query``)."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
import zmq
from numpy.typing import NDArray

from t4nmtd_dist.errors import ConfigError, ProtocolError
from t4nmtd_dist.learners.peers import InterventionCounts, PeerValues, joined
from t4nmtd_dist.wire.codec import Envelope, decode
from t4nmtd_dist.wire.keys import ClientKeys
from t4nmtd_dist.wire.messages import Peer, ValueReply, ValueRequest
from t4nmtd_dist.wire.sockets import Context, Socket, connect, send

ROWS_PER_REQUEST = 64
REQUESTS_IN_FLIGHT = 4
DEADLINE_S = 0.2
MISSES_UNTIL_NO_WAIT = 3
HANDSHAKE_MS = 2000  # a peer that does not know of us yet stays silent; ask again then

Question = tuple[int, NDArray[np.float32], int]


@dataclass
class _Line:
    """The connection to one peer."""

    peer: Peer
    socket: Socket
    unsent: list[Question] = field(default_factory=list)
    in_flight: dict[int, list[int]] = field(default_factory=dict)
    misses: int = 0


class QueryPeers:
    """Peers in other processes: requests go out while the roll-out is collected, answers are gathered at its end.

    A peer that is away, slow or unknown costs at most one short deadline; its rows are then left unanswered, and
    the learner falls back to its own critic. After three misses in a row a peer is no longer waited for until it
    answers again.

    Args:
        context: the process's ZeroMQ context.
        sender: the name that requests carry.
        keys: this worker's own, if the coordinator has keys; each peer's public key comes with its address.
        value_shape: shape of one answer: () for PPO, (2,) for SAC; any other counts as none.
    """

    def __init__(
        self, context: Context, sender: str, keys: ClientKeys | None = None, value_shape: tuple[int, ...] = ()
    ) -> None:
        self._context, self._sender, self._keys = context, sender, keys
        self._value_shape = value_shape
        self._lines: dict[str, _Line] = {}
        self._next_id = 0
        self._answers: list[tuple[list[int], NDArray[np.float32]]] = []
        self._asked_now = 0
        self.counts = InterventionCounts()

    def set_peers(self, peers: Mapping[str, Peer]) -> None:
        """Where peers answer now; a peer that moved is connected to anew."""
        for pid in set(self._lines) - set(peers):
            self._lines.pop(pid).socket.close(0)
        for pid, peer in peers.items():
            line = self._lines.get(pid)
            if line is not None and (line.peer.endpoint, line.peer.key) == (peer.endpoint, peer.key):
                line.peer = peer
                continue
            if line is not None:
                self._lines.pop(pid).socket.close(0)
            with suppress(ConfigError):  # a peer without a usable address counts as away
                self._lines[pid] = _Line(peer, self._connect(peer))

    def _connect(self, peer: Peer) -> Socket:
        if self._keys is None:
            return connect(self._context, peer.endpoint)
        if not peer.key:
            raise ConfigError("a peer without a key is not asked while this worker has keys")
        return connect(self._context, peer.endpoint, self._keys.to(peer.key), handshake_ms=HANDSHAKE_MS)

    def close(self) -> None:
        """Close all connections."""
        self.set_peers({})

    def ask(self, row: int, pid: str, observation: NDArray[np.float32], q: int) -> None:
        """See ``PeerCritics.ask``."""
        self.counts.asked += 1
        self._asked_now += 1
        line = self._lines.get(pid)
        if line is None:
            return
        line.unsent.append((row, observation.copy(), q))
        if len(line.unsent) >= ROWS_PER_REQUEST and len(line.in_flight) < REQUESTS_IN_FLIGHT:
            self._request(pid, line)

    def _request(self, pid: str, line: _Line) -> None:
        questions, line.unsent = line.unsent, []
        self._next_id += 1
        arrays = {
            "observation": np.stack([observation for _, observation, _ in questions]),
            "q": np.array([q for _, _, q in questions], np.int32),
        }
        if send(line.socket, Envelope(ValueRequest(pid=pid), arrays, self._sender, self._next_id)):
            line.in_flight[self._next_id] = [row for row, _, _ in questions]

    def gather(self) -> PeerValues:
        """See ``PeerCritics.gather``; waits at most ``DEADLINE_S`` in all."""
        for pid, line in self._lines.items():
            if line.unsent:
                self._request(pid, line)
        deadline = time.monotonic() + DEADLINE_S
        for line in self._lines.values():
            self._drain(line, deadline)
            line.misses = line.misses + 1 if line.in_flight else 0
            line.in_flight.clear()
        answers, self._answers = self._answers, []
        rows = [row for numbers, _ in answers for row in numbers]
        self.counts.answered += len(rows)
        self.counts.own_used += self._asked_now - len(rows)
        self._asked_now = 0
        values = [values for _, values in answers]
        return PeerValues(np.array(rows, np.int64), joined(values))

    def _drain(self, line: _Line, deadline: float) -> None:
        while True:
            wait = line.in_flight and line.misses < MISSES_UNTIL_NO_WAIT
            patience = max(0.0, deadline - time.monotonic()) if wait else 0.0
            if not line.socket.poll(int(patience * 1000)):
                return
            try:
                self._take(line, decode(line.socket.recv_multipart(flags=zmq.NOBLOCK)))
            except ProtocolError:
                continue  # an unreadable answer counts as none: its rows fall back to the own critic

    def _take(self, line: _Line, envelope: Envelope) -> None:
        reply = envelope.message
        rows = line.in_flight.pop(envelope.id, None)
        if rows is None:
            self.counts.late += 1
            line.misses = min(line.misses, MISSES_UNTIL_NO_WAIT - 1)  # it answers again: wait for it once more
            return
        values = envelope.arrays.get("value")
        if not isinstance(reply, ValueReply) or values is None or values.shape != (len(rows), *self._value_shape):
            return
        if values.dtype != np.float32 or not np.isfinite(values).all():
            return
        self.counts.lag_total += max(0, line.peer.version - reply.version) * len(rows)
        self._answers.append((rows, values))
