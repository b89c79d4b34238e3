"""What a bound socket takes in: only from keys that are still allowed, and only as much as its limits allow."""

from __future__ import annotations

import os
import socket as sockets
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import zmq

from t4nmtd_dist.errors import ProtocolError
from t4nmtd_dist.wire.allow_list import AllowedKeys
from t4nmtd_dist.wire.codec import Envelope, decode
from t4nmtd_dist.wire.limits import CONNECTIONS_REMEMBERED, Limits, RateLimiter
from t4nmtd_dist.wire.notices import Notices, Tell
from t4nmtd_dist.wire.sockets import Socket


@dataclass(frozen=True)
class Arrival:
    """A message at a ROUTER.

    Attributes:
        peer: the connection it came over.
        key: the sender's public key; empty on a socket without keys.
        content: the message, or why it cannot be read.
    """

    peer: bytes
    key: str
    content: Envelope | ProtocolError


@dataclass(frozen=True)
class _Connection:
    """A TCP connection by its descriptor, and by the inode that tells it from a later one of the same number."""

    key: str
    descriptor: int
    inode: int

    def end(self) -> bool:
        """Shut it down; False if it had ended already."""
        with suppress(OSError), sockets.socket(fileno=os.dup(self.descriptor)) as duplicate:
            if os.fstat(duplicate.fileno()).st_ino == self.inode:
                duplicate.shutdown(sockets.SHUT_RDWR)
                return True
        return False


class Gate:
    """Stands before a bound ROUTER or XPUB socket.

    ZeroMQ asks for a key in the handshake only. So each message's key is looked up again, and ``expel`` ends
    connections whose key is no longer allowed: libzmq tells which descriptor a message came over.

    Args:
        socket: the bound socket.
        limits: what each connection may send.
        allowed: who may connect; None for a socket without keys.
        tell: called with a line about each connection that is shut out or sends too much.
    """

    def __init__(self, socket: Socket, limits: Limits, allowed: AllowedKeys | None, tell: Tell) -> None:
        self._socket, self._allowed, self._notices = socket, allowed, Notices(tell)
        self._rates = RateLimiter(limits)
        self._connections: OrderedDict[tuple[int, int], _Connection] = OrderedDict()

    def arrivals(self, most: int) -> Iterator[Arrival]:
        """The messages that wait at a ROUTER, at most ``most`` of them, refused ones included in the count."""
        for _ in range(most):
            try:
                frames = self._socket.recv_multipart(flags=zmq.NOBLOCK, copy=False)
            except zmq.Again:
                return
            peer, content = frames[0].bytes, frames[1:]
            key = self._key(frames[-1])
            if key is None or not self._within_rate(peer, key, sum(len(frame) for frame in content)):
                continue
            yield Arrival(peer, key, _decoded([frame.bytes for frame in content]))

    def subscribed(self) -> bool:
        """Take one message from an XPUB; whether it is a subscription of somebody allowed."""
        frame = self._socket.recv(copy=False)
        key = self._key(frame)
        return key is not None and frame.bytes[:1] == b"\x01"

    def _key(self, frame: zmq.Frame) -> str | None:
        """The sender's key ("" on a socket without keys), or None for one that is not allowed."""
        if self._allowed is None:
            return ""
        key = _text(frame, "User-Id")
        self._remember(frame, key)
        if key and key in self._allowed:
            return key
        self.expel()
        return None

    def _remember(self, frame: zmq.Frame, key: str) -> None:
        with suppress(OSError, zmq.ZMQError, TypeError):
            descriptor = int(frame.get(zmq.SRCFD))
            inode = os.fstat(descriptor).st_ino
            self._connections[descriptor, inode] = _Connection(key, descriptor, inode)
            self._connections.move_to_end((descriptor, inode))
            if len(self._connections) > CONNECTIONS_REMEMBERED:
                self._connections.popitem(last=False)

    def expel(self) -> None:
        """End all connections whose key is no longer allowed."""
        if self._allowed is None:
            return
        for number, connection in list(self._connections.items()):
            if connection.key not in self._allowed:
                del self._connections[number]
                if connection.end():
                    self._notices.once(f"ended the connection of key {connection.key}, which is no longer allowed")

    def _within_rate(self, peer: bytes, key: str, size: int) -> bool:
        if self._rates.allows(peer, size):
            return True
        who = self._allowed.name(key) if self._allowed is not None else f"connection {peer.hex()}"
        self._notices.once(f"{who} sends more than {self._socket_limits()}; what is over that is dropped")
        return False

    def _socket_limits(self) -> str:
        limits = self._rates.limits
        return f"{limits.messages_per_s:.0f} messages or {limits.bytes_per_s / 2**20:.1f} MiB a second"


def _decoded(frames: list[bytes]) -> Envelope | ProtocolError:
    try:
        return decode(frames)
    except ProtocolError as error:
        return error


def _text(frame: zmq.Frame, name: str) -> str:
    try:
        return str(frame.get(name))
    except zmq.ZMQError:
        return ""
