"""Limits on what a connection may send to each bound socket."""

from __future__ import annotations

import time
from collections import OrderedDict
from dataclasses import dataclass

from t4nmtd_dist.wire.codec import MAX_ARRAY_BYTES, MAX_MESSAGE_BYTES, MAX_REQUEST_HEADER_BYTES

CONNECTIONS_REMEMBERED = 4096
BURST_S = 4.0


@dataclass(frozen=True)
class Limits:
    """Limits of one bound socket, per connection.

    Attributes:
        frame_bytes: size of one frame; ZeroMQ drops senders that exceed it.
        messages_per_s: messages per second, averaged over ``BURST_S`` seconds.
        bytes_per_s: bytes per second, averaged likewise.
        unread_bytes: bytes received but not delivered; exceeding it ends the connection. The state socket delivers
            nothing, so there it bounds all bytes ever received.
        connections: maximum number of connections.
        queued: maximum send queue, in messages.
    """

    frame_bytes: int
    messages_per_s: float
    bytes_per_s: float
    unread_bytes: int = MAX_MESSAGE_BYTES + MAX_REQUEST_HEADER_BYTES
    connections: int = 256
    queued: int = 100


STARTS_BYTES = MAX_ARRAY_BYTES // 2  # limit of the start states in one message


def most_starts(count: int, size: int) -> int:
    """How many start states of ``size`` bytes fit into a message: from 1 to ``count``."""
    return min(count, max(1, STARTS_BYTES // max(1, size)))


CONTROL_LIMITS = Limits(MAX_ARRAY_BYTES, 500, 128 << 20)
CRITIC_LIMITS = Limits(8 << 20, 2000, 64 << 20, unread_bytes=9 << 20, queued=20)
STATE_LIMITS = Limits(1024, 10, 1024, unread_bytes=4096, connections=64, queued=20)
"""On the state socket, what comes in is nothing but a handshake and subscriptions."""


class RateLimiter:
    """Two token buckets per connection, for messages and bytes."""

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self._spent: OrderedDict[bytes, tuple[float, float, float]] = OrderedDict()

    def allows(self, peer: bytes, size: int, now: float | None = None) -> bool:
        """Count a message of ``size`` bytes; False, uncounted, if its connection exceeds a rate."""
        now = time.monotonic() if now is None else now
        messages, volume, since = self._spent.pop(peer, (0.0, 0.0, now))
        messages = max(0.0, messages - (now - since) * self.limits.messages_per_s)
        volume = max(0.0, volume - (now - since) * self.limits.bytes_per_s)
        within = messages + 1 <= self.limits.messages_per_s * BURST_S and volume <= self.limits.bytes_per_s * BURST_S
        self._spent[peer] = (messages + 1, volume + size, now) if within else (messages, volume, now)
        if len(self._spent) > CONNECTIONS_REMEMBERED:
            self._spent.popitem(last=False)
        return within
