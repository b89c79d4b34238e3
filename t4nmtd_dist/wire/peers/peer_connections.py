"""Connections to peers in other processes, at addresses from the coordinator."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import zmq

from t4nmtd_dist.core.errors import ConfigError, ProtocolError
from t4nmtd_dist.wire.auth.keys import ClientKeys
from t4nmtd_dist.wire.codec import Arrays, Envelope, decode
from t4nmtd_dist.wire.messages import Message, Peer
from t4nmtd_dist.wire.sockets import connect, send
from t4nmtd_dist.wire.zmq_types import Context, Socket

HANDSHAKE_MS = 2000  # a peer that does not know this worker yet does not answer; retry


class Connected(Protocol):
    """A connection's peer, as last reported by the coordinator, and socket."""

    peer: Peer
    socket: Socket


ConnectionT = TypeVar("ConnectionT", bound=Connected)


@dataclass
class PeerConnections(Generic[ConnectionT]):
    """One connection per peer.

    Attributes:
        keys: this worker's own, if the coordinator has keys; the coordinator supplies each peer's public key.
        make: wraps a peer and its connected socket.
    """

    context: Context
    keys: ClientKeys | None
    make: Callable[[Peer, Socket], ConnectionT]

    def __post_init__(self) -> None:
        self.by_pid: dict[str, ConnectionT] = {}

    def set_peers(self, peers: Mapping[str, Peer]) -> None:
        """Update the peers; reconnects those that moved and drops those without a usable address."""
        for pid in set(self.by_pid) - set(peers):
            self.by_pid.pop(pid).socket.close(0)
        for pid, peer in peers.items():
            connection = self.by_pid.get(pid)
            if connection is not None and (connection.peer.endpoint, connection.peer.key) == (peer.endpoint, peer.key):
                connection.peer = peer
                continue
            if connection is not None:
                self.by_pid.pop(pid).socket.close(0)
            with suppress(ConfigError):
                self.by_pid[pid] = self.make(peer, self._connect(peer))

    def _connect(self, peer: Peer) -> Socket:
        if self.keys is None:
            return connect(self.context, peer.endpoint)
        if not peer.key:
            raise ConfigError("a peer without a key is not asked while this worker has keys")
        return connect(self.context, peer.endpoint, self.keys.to(peer.key), handshake_ms=HANDSHAKE_MS)


class PeerClient(Generic[ConnectionT]):
    """Base of all clients of peers in other processes.

    Args:
        keys: this worker's own, if the coordinator has keys.
        make: wraps a peer and its connected socket.
        clock: monotonic, in seconds.
    """

    def __init__(
        self,
        context: Context,
        sender: str,
        keys: ClientKeys | None,
        make: Callable[[Peer, Socket], ConnectionT],
        clock: Callable[[], float],
    ) -> None:
        self._sender, self._clock = sender, clock
        self._connections = PeerConnections(context, keys, make)
        self._next_id = 0

    def set_peers(self, peers: Mapping[str, Peer]) -> None:
        """Update the peers' addresses; reconnects those that moved."""
        self._connections.set_peers(peers)

    def close(self) -> None:
        """Close all connections."""
        self.set_peers({})

    def _send(self, connection: ConnectionT, message: Message, arrays: Arrays | None = None) -> int:
        """Send a request; returns its number, or 0 if impossible now."""
        self._next_id += 1
        sent = send(connection.socket, Envelope(message, arrays or {}, self._sender, self._next_id))
        return self._next_id if sent else 0


def arrived(socket: Socket, patience_s: float = 0.0) -> Iterator[Envelope]:
    """Yield the valid messages waiting at a DEALER, after waiting up to ``patience_s`` for the first."""
    patience_ms = int(patience_s * 1000)
    while socket.poll(patience_ms):
        patience_ms = 0
        with suppress(ProtocolError, zmq.Again):
            yield decode(socket.recv_multipart(flags=zmq.NOBLOCK))
