"""Receives messages from allowed keys only, within a bound socket's limits."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass

import zmq

from t4nmtd_dist.core.errors import ProtocolError
from t4nmtd_dist.wire.auth.allow_list import AllowedKeys
from t4nmtd_dist.wire.codec import MAX_REQUEST_HEADER_BYTES, Envelope, decode
from t4nmtd_dist.wire.connection_guard import ConnectionGuard
from t4nmtd_dist.wire.connections import Connection, connection_of
from t4nmtd_dist.wire.limits import CONNECTIONS_REMEMBERED, Limits, RateLimiter
from t4nmtd_dist.wire.rate_limited_log import Log, RateLimitedLog
from t4nmtd_dist.wire.zmq_types import Socket


@dataclass(frozen=True)
class Arrival:
    """A message received by a ROUTER.

    Attributes:
        peer: the connection it came over.
        key: the sender's public key; empty without keys.
        content: the message, or why it cannot be read.
    """

    peer: bytes
    key: str
    content: Envelope | ProtocolError


class SecureReceiver:
    """Receives at a bound ROUTER or XPUB socket, within limits and from allowed keys only.

    ZeroMQ checks keys only in the handshake; the receiver checks the key of every message. ``disconnect_revoked`` ends
    connections whose key is no longer allowed.

    Args:
        allowed: the allowed keys; None for a socket without keys.
        tell: logs each connection ended or over its rate.
        guard: counts delivered bytes per connection.
    """

    def __init__(
        self,
        socket: Socket,
        limits: Limits,
        allowed: AllowedKeys | None,
        tell: Log,
        guard: ConnectionGuard | None = None,
    ) -> None:
        self._socket, self._allowed, self._notices, self._guard = socket, allowed, RateLimitedLog(tell), guard
        self._rates = RateLimiter(limits)
        self._keys: OrderedDict[Connection, str] = OrderedDict()

    def arrivals(self, most: int) -> Iterator[Arrival]:
        """Yield the messages waiting at a ROUTER; reads at most ``most``, rejected ones included."""
        for _ in range(most):
            try:
                frames = self._socket.recv_multipart(flags=zmq.NOBLOCK, copy=False)
            except zmq.Again:
                if self._guard is not None:
                    self._guard.drained()
                return
            peer, content = frames[0].bytes, frames[1:]
            size = sum(len(frame) for frame in content)
            if self._guard is not None:
                self._guard.delivered(connection_of(frames[-1]), size)
            key = self._key(frames[-1])
            if key is None or not self._within_rate(peer, key, size):
                continue
            yield Arrival(peer, key, _decoded([frame.bytes for frame in content]))

    def subscribed(self, most: int) -> bool:
        """Read up to ``most`` messages from an XPUB; whether an allowed client subscribed.

        Subscriptions over the rate limit are ignored. Their connection is not ended here, because its descriptor may
        already belong to another one; the guard ends it if needed.
        """
        subscribed = False
        for _ in range(most):
            try:
                frame = self._socket.recv(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                break
            key, over = self._key(frame), connection_of(frame)
            if key is None or over is None or not self._within_rate(b"%d" % over.descriptor, key, len(frame)):
                continue
            subscribed |= frame.bytes[:1] == b"\x01"
        return subscribed

    def _key(self, frame: zmq.Frame) -> str | None:
        """The sender's key, "" on a socket without keys, or None if not allowed."""
        if self._allowed is None:
            return ""
        key = _text(frame, "User-Id")
        self._remember(frame, key)
        if key and key in self._allowed:
            return key
        self.disconnect_revoked()
        return None

    def _remember(self, frame: zmq.Frame, key: str) -> None:
        over = connection_of(frame)
        if over is None:
            return
        self._keys[over] = key
        self._keys.move_to_end(over)
        if len(self._keys) > CONNECTIONS_REMEMBERED:
            self._keys.popitem(last=False)

    def disconnect_revoked(self) -> None:
        """End all connections whose key is no longer allowed."""
        if self._allowed is None:
            return
        for over, key in list(self._keys.items()):
            if key not in self._allowed:
                del self._keys[over]
                if over.end():
                    self._notices.log(f"ended the connection of key {key}, which is no longer allowed")

    def _within_rate(self, peer: bytes, key: str, size: int) -> bool:
        if self._rates.allows(peer, size):
            return True
        who = self._allowed.name(key) if self._allowed is not None else "a connection"
        self._notices.log(f"{who} sends more than {self._socket_limits()}; what is over that is dropped")
        return False

    def _socket_limits(self) -> str:
        limits = self._rates.limits
        return f"{limits.messages_per_s:.0f} messages or {limits.bytes_per_s / 2**20:.1f} MiB a second"


def _decoded(frames: list[bytes]) -> Envelope | ProtocolError:
    try:
        return decode(frames, header_bytes=MAX_REQUEST_HEADER_BYTES)
    except ProtocolError as error:
        return error


def _text(frame: zmq.Frame, name: str) -> str:
    try:
        return str(frame.get(name))
    except zmq.ZMQError:
        return ""
