"""The connection to the coordinator, served by its own thread.

The thread renews leases and receives messages while the learner loop computes or imports for minutes. The two exchange
messages through queues; only the thread uses the socket.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from queue import Empty, SimpleQueue

import zmq

from t4nmtd_dist.core.errors import ProtocolError
from t4nmtd_dist.wire.auth.handshake import HandshakeMonitor, Outcome
from t4nmtd_dist.wire.auth.keys import ClientKeys
from t4nmtd_dist.wire.codec import Envelope, encode
from t4nmtd_dist.wire.messages import Notice
from t4nmtd_dist.wire.sockets import connect, receive, send_frames
from t4nmtd_dist.wire.zmq_types import Context, Socket
from workers.lease_renewal import LeaseRenewals
from workers.loop_watch import LoopWatch
from workers.say import say

POLL_MS = 50
STOPPED_S = 2.0  # a longer gap between two turns of the thread means the process did not run
CLOSE_S = 5.0
LINGER_MS = 200

_numbers = count(1)


@dataclass(frozen=True)
class Arrival:
    """Something received over the connection.

    Attributes:
        at: time of arrival.
        content: a message, why one cannot be read, or a handshake outcome.
        renewal: whether it only answers a lease renewal.
    """

    at: float
    content: Envelope | ProtocolError | Outcome
    renewal: bool = False


@dataclass(frozen=True)
class _Outgoing:
    envelope: Envelope
    frames: list[bytes]
    taken: Future[bool]


class StopClock:
    """Sums the time the process did not run (SIGSTOP, a suspended laptop), from the gaps between beats."""

    def __init__(self, now: float) -> None:
        self._lock = threading.Lock()
        self._last, self._stopped_s = now, 0.0

    def beat(self, now: float) -> None:
        """Record that the thread is running; call several times a second."""
        with self._lock:
            self._stopped_s += self._gap(now)
            self._last = now

    def stopped_s(self, now: float) -> float:
        """Total seconds stopped, including an ongoing gap."""
        with self._lock:
            return self._stopped_s + self._gap(now)

    def _gap(self, now: float) -> float:
        gap = now - self._last
        return gap if gap > STOPPED_S else 0.0


class ControlConnection:
    """The loop's side of the connection; call all methods from the loop's thread.

    Args:
        keys: this worker's, if the coordinator has keys.
        watch: detects a hung loop, whose leases are not renewed.

    Raises:
        ConfigError: if the endpoint cannot be used.
    """

    def __init__(
        self, context: Context, endpoint: str, instance: str, keys: ClientKeys | None, watch: LoopWatch
    ) -> None:
        self._instance = instance
        self._arrived: SimpleQueue[Arrival | Exception] = SimpleQueue()
        self._outgoing: deque[_Outgoing | str] = deque()
        self._wake, theirs = _pair(context)
        self._clock = StopClock(time.monotonic())
        socket = connect(context, endpoint, keys, monitored=True)
        self._service = _Service(socket, theirs, self._arrived, self._outgoing, self._clock, watch, instance)
        self._service.start()

    def send(self, envelope: Envelope) -> Future[bool]:
        """Send a message; the future tells whether the socket accepted it, which needs a connection.

        Raises:
            ProtocolError: if its arrays are invalid or too large.
        """
        outgoing = _Outgoing(envelope, encode(envelope), Future())
        self._put(outgoing)
        return outgoing.taken

    def forget(self, pid: str) -> None:
        """Stop renewing a sub-task's lease, until the next message under it."""
        self._put(pid)

    def _put(self, item: _Outgoing | str) -> None:
        self._outgoing.append(item)
        with suppress(zmq.Again):  # then the thread is awake already
            self._wake.send(b"", zmq.NOBLOCK)

    def receive(self, timeout_s: float) -> Arrival | None:
        """The next arrival, or None after ``timeout_s`` seconds.

        Raises:
            Exception: whatever ended the connection's thread.
        """
        try:
            arrival = self._arrived.get(timeout=timeout_s) if timeout_s > 0 else self._arrived.get_nowait()
        except Empty:
            return None
        if isinstance(arrival, Exception):
            raise arrival
        return arrival

    def stopped_s(self) -> float:
        """Seconds since the start in which this process did not run."""
        return self._clock.stopped_s(time.monotonic())

    def close(self) -> None:
        """Send what is queued and close the connection."""
        self._service.stop.set()
        with suppress(zmq.Again):
            self._wake.send(b"", zmq.NOBLOCK)
        self._service.join(CLOSE_S)
        self._wake.close(0)


class _Service(threading.Thread):
    """The thread's side; it owns the socket once started."""

    def __init__(
        self,
        socket: Socket,
        wake: Socket,
        arrived: SimpleQueue[Arrival | Exception],
        outgoing: deque[_Outgoing | str],
        clock: StopClock,
        watch: LoopWatch,
        instance: str,
    ) -> None:
        super().__init__(name="control-connection", daemon=True)
        self._socket, self._wake, self._instance = socket, wake, instance
        self._arrived, self._outgoing = arrived, outgoing
        self._clock, self._watch = clock, watch
        self._handshakes = HandshakeMonitor(socket)
        self._renewals = LeaseRenewals()
        self._poller = zmq.Poller()
        for polled in (socket, wake):
            self._poller.register(polled, zmq.POLLIN)
        self.stop = threading.Event()

    def run(self) -> None:
        """Serve until stopped; passes unexpected errors to the loop."""
        try:
            while not self.stop.is_set():
                self._turn()
            self._send_all()
        except Exception as error:
            self._arrived.put(error)
        finally:
            self._close()

    def _turn(self) -> None:
        self._poller.poll(POLL_MS)
        self._clock.beat(time.monotonic())
        while self._wake.poll(0):
            self._wake.recv()
        self._receive_all()
        self._send_all()
        self._look_after_loop(time.monotonic())

    def _receive_all(self) -> None:
        while (outcome := self._handshakes.next()) is not None:
            self._arrived.put(Arrival(time.monotonic(), outcome))
        while self._socket.poll(0):
            now = time.monotonic()
            try:
                envelope = receive(self._socket, 0.0)
            except ProtocolError as error:
                self._arrived.put(Arrival(now, error))
                continue
            if envelope is not None:
                self._arrived.put(Arrival(now, *self._renewals.received(envelope)))

    def _send_all(self) -> None:
        while self._outgoing:
            item = self._outgoing.popleft()
            if isinstance(item, str):
                self._renewals.forget(item)
                continue
            self._renewals.sent(item.envelope, time.monotonic())
            item.taken.set_result(send_frames(self._socket, item.frames))

    def _look_after_loop(self, now: float) -> None:
        text = self._watch.check(now, self._clock.stopped_s(now))
        if text is not None:
            say(text)
            send_frames(self._socket, encode(Envelope(Notice(text=text), {}, self._instance)))
        if not self._watch.hangs:
            for renewal in self._renewals.due(now):
                send_frames(self._socket, encode(Envelope(renewal.message, {}, self._instance, renewal.id)))

    def _close(self) -> None:
        while self._outgoing:
            item = self._outgoing.popleft()
            if isinstance(item, _Outgoing):
                item.taken.set_result(False)
        self._handshakes.close()
        self._wake.close(0)
        self._socket.close(LINGER_MS)


def _pair(context: Context) -> tuple[Socket, Socket]:
    """Two connected in-process sockets."""
    ours, theirs = context.socket(zmq.PAIR), context.socket(zmq.PAIR)
    name = f"inproc://control-{next(_numbers)}"
    theirs.bind(name)
    ours.connect(name)
    return ours, theirs
