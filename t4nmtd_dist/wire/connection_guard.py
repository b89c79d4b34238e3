"""Bounds the connections of a bound socket and what they make libzmq buffer.

libzmq delivers a message after its last frame and only limits single frames. This guard compares the bytes each
connection has received, which the kernel counts, with those delivered. Shutting a connection down frees its buffer.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import zmq
from zmq.utils.monitor import recv_monitor_message

from t4nmtd_dist.process.memory import trim_memory
from t4nmtd_dist.wire.auth.handshake import Outcome, outcome_of
from t4nmtd_dist.wire.connections import Connection, connection
from t4nmtd_dist.wire.limits import Limits
from t4nmtd_dist.wire.rate_limited_log import Log
from t4nmtd_dist.wire.zmq_types import MONITORED, Socket

WATCHED = MONITORED | zmq.EVENT_ACCEPTED | zmq.EVENT_CLOSED
QUIET_MS, BUSY_MS = 20, 2
BUSY_BYTES = 4096  # received since the last check: check again soon
SMALL_FRAMES_BYTES = 64 << 10  # unread bytes above which process growth is blamed on them
GROWTH_BYTES = 32 << 20
MOST_GROWTH_BYTES = 4 * GROWTH_BYTES  # above this, blame all connections together
SUBSTANTIAL = 16  # process growth is not blamed on less than 1/16 of the unread limit
TRIM_AFTER_S = 0.5  # time for libzmq to free its buffers
TOTAL = 2  # unread limit of all connections together, in multiples of the limit of one


@dataclass
class _Account:
    """Byte counts of one connection.

    Attributes:
        base: bytes received when the socket was last drained.
        delivered: bytes of messages delivered since then.
        received: bytes received at the last check.
    """

    connection: Connection
    base: int = 0
    delivered: int = 0
    received: int = 0

    @property
    def unread(self) -> int:
        """Bytes received and not delivered, framing included."""
        return max(0, self.received - self.base - self.delivered)


class ConnectionGuard:
    """Watches all connections of a bound socket in its own thread; create it before using the socket.

    Args:
        tell: logs, in that thread, each connection shut down.
        failed: called in that thread with the outcome of each failed handshake.
    """

    def __init__(
        self, socket: Socket, limits: Limits, tell: Log, failed: Callable[[Outcome], None] = lambda outcome: None
    ) -> None:
        self._socket, self._limits, self._tell, self._failed = socket, limits, tell, failed
        self._monitor: Socket = socket.get_monitor_socket(WATCHED)
        self._accounts: dict[Connection, _Account] = {}
        self._open: dict[int, Connection] = {}
        self._memory_before = 0
        self._trim_at: float | None = None
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._loop, name="connection-guard", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop watching; call this before closing the socket."""
        self._stop.set()
        self._thread.join(timeout=2.0)
        self._socket.disable_monitor()
        self._monitor.close(0)

    def delivered(self, over: Connection | None, size: int) -> None:
        """Record that a message of ``size`` bytes was delivered from a connection."""
        with self._lock:
            if self._memory_before:
                self._memory_before += size  # its receiver may keep it
            account = self._accounts.get(over) if over is not None else None
            if account is not None:
                account.delivered += size

    def drained(self) -> None:
        """Record that only incomplete messages are buffered."""
        with self._lock:
            for account in self._accounts.values():
                if account.delivered:
                    account.base, account.delivered = account.connection.received() or account.received, 0

    def _loop(self) -> None:
        pause_ms = QUIET_MS
        while not self._stop.is_set():
            if self._monitor.poll(pause_ms):
                self._follow_connections()
            pause_ms = BUSY_MS if self._look() else QUIET_MS
            if self._trim_at is not None and time.monotonic() > self._trim_at:
                self._trim_at = None
                trim_memory()

    def _follow_connections(self) -> None:
        while self._monitor.poll(0):
            event = recv_monitor_message(self._monitor)
            kind, descriptor = int(event["event"]), int(event["value"])
            if kind == zmq.EVENT_ACCEPTED:
                self._accept(descriptor)
            elif kind in (zmq.EVENT_DISCONNECTED, zmq.EVENT_CLOSED):
                self._forget(descriptor)
            outcome = outcome_of(event)
            if outcome in ("broken", "mechanism"):
                self._failed(outcome)

    def _accept(self, descriptor: int) -> None:
        accepted = connection(descriptor)
        self._forget(descriptor)
        if accepted is None:
            return
        with self._lock:
            account = self._accounts[accepted] = _Account(accepted)
            self._open[descriptor] = accepted
            if len(self._accounts) > self._limits.connections:
                self._end(account, f"ended a connection: more than {self._limits.connections} are open")

    def _forget(self, descriptor: int) -> None:
        with self._lock:
            ended = self._open.pop(descriptor, None)
            if ended is not None:
                self._accounts.pop(ended, None)

    def _look(self) -> bool:
        """Update byte counts and end greedy connections; whether much arrived."""
        busy = False
        with self._lock:
            for account in list(self._accounts.values()):
                received = account.connection.received()
                if received is None:
                    continue
                busy |= received > account.received + BUSY_BYTES
                account.received = received
                if account.unread > self._limits.unread_bytes:
                    self._end(account, self._too_much())
            self._bound_all()
        return busy

    def _bound_all(self) -> None:
        """End the connection with the most unread bytes if all together cost too much."""
        most = max(self._accounts.values(), key=lambda account: account.unread, default=None)
        unread = sum(account.unread for account in self._accounts.values())
        if most is None or unread < SMALL_FRAMES_BYTES:
            self._memory_before = 0
            return
        memory = _resident()
        self._memory_before = min(self._memory_before or memory, memory)
        grown = memory - self._memory_before - unread
        if unread > TOTAL * self._limits.unread_bytes or self._costs_too_much(grown, most.unread, unread):
            self._end(most, self._too_much())
            self._memory_before = 0

    def _costs_too_much(self, grown: int, most: int, unread: int) -> bool:
        """Whether unread bytes explain too much growth of the process."""
        substantial = self._limits.unread_bytes // SUBSTANTIAL
        blamed = unread if grown > MOST_GROWTH_BYTES else most
        return grown > GROWTH_BYTES and blamed > substantial

    def _too_much(self) -> str:
        mebibytes = self._limits.unread_bytes / 2**20
        return f"ended a connection that sent more than can be taken in: at most {mebibytes:.3g} MiB may be unread"

    def _end(self, account: _Account, text: str) -> None:
        self._accounts.pop(account.connection, None)
        if account.connection.end():
            self._trim_at = time.monotonic() + TRIM_AFTER_S
            self._tell(text)


def _resident() -> int:
    """Resident memory of this process in bytes (Linux)."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGESIZE")
