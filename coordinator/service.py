"""The coordinator's sockets and clock around its state machine."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from pathlib import Path

import zmq

from coordinator.events import Event, Finish, Interrupted, Received, Send, Tick
from coordinator.recorder import Recorder
from coordinator.snapshot import dashboard_state
from coordinator.state import CoordinatorState
from t4nmtd_dist.errors import ProtocolError
from t4nmtd_dist.runs.directory import RunDirectory
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import Failure
from t4nmtd_dist.wire.sockets import bind, bound_endpoint, new_context, receive_from, send

TICK_S = 0.1
PUBLISH_S = 0.2
FAREWELL_S = 1.5
MESSAGES_PER_TURN = 200


class CoordinatorService:
    """Listens, feeds the state machine, carries out its actions, and publishes its state.

    Args:
        state: the state machine.
        directory: the run directory; made only once the endpoints are taken.
        endpoints: where workers are heard, and where the state is published.
        restart: delete a run that the directory holds.
        insecure: allow addresses that other machines can reach.

    Raises:
        ConfigError: if an endpoint cannot be used.
        RunError: if the run directory cannot be used.
    """

    def __init__(
        self,
        state: CoordinatorState,
        directory: Path,
        endpoints: tuple[str, str],
        *,
        restart: bool = False,
        insecure: bool = False,
    ) -> None:
        self.state = state
        with ExitStack() as undo:
            self._context = new_context()
            undo.callback(self._context.destroy, 0)
            self._control = bind(self._context, zmq.ROUTER, endpoints[0], insecure=insecure)
            self._publisher = bind(self._context, zmq.XPUB, endpoints[1], insecure=insecure)
            run = RunDirectory(directory, restart=restart)
            undo.pop_all()
        self.control, self.publish = bound_endpoint(self._control), bound_endpoint(self._publisher)
        self._recorder = Recorder(state, run)
        run.write_endpoints(self.control, self.publish)
        self._poller = zmq.Poller()
        self._poller.register(self._control, zmq.POLLIN)
        self._poller.register(self._publisher, zmq.POLLIN)
        self._publish_due = 0.0
        self._interrupt: str | None = None
        self._over = threading.Event()

    def interrupt(self, reason: str) -> None:
        """Ask the loop to end the run; callable from a signal handler or another thread."""
        self._interrupt = reason

    def serve(self) -> None:
        """Run until the state machine finishes, then tell latecomers for a moment that it is over."""
        try:
            while not self._over.is_set():
                self._turn()
            farewell = time.monotonic() + FAREWELL_S
            while time.monotonic() < farewell:
                self._turn()
        finally:
            self._control.close(500)
            self._publisher.close(500)
            self._context.term()

    def _turn(self) -> None:
        ready = dict(self._poller.poll(int(TICK_S * 1000)))
        if self._control in ready:
            self._receive()
        if self._publisher in ready and self._publisher.recv()[:1] == b"\x01":
            self._publish_due = 0.0
        if self._interrupt is not None:
            self._feed(Interrupted(time.monotonic(), self._interrupt))
            self._interrupt = None
        self._feed(Tick(time.monotonic()))
        self._publish_state()
        if not self._over.is_set():
            self._recorder.metrics()

    def _receive(self) -> None:
        for _ in range(MESSAGES_PER_TURN):
            received = receive_from(self._control)
            if received is None:
                return
            peer, envelope = received
            if isinstance(envelope, ProtocolError):
                send(self._control, Envelope(Failure(text=str(envelope))), peer=peer)
            else:
                self._feed(Received(time.monotonic(), peer, envelope))

    def _feed(self, event: Event) -> None:
        for action in self.state.handle(event):
            if isinstance(action, Send):
                envelope = Envelope(action.message, action.arrays, "coordinator", action.answers)
                send(self._control, envelope, peer=action.peer)
                continue
            self._recorder.record(action)
            if isinstance(action, Finish):
                self._publish_due = 0.0
                self._over.set()

    def _publish_state(self) -> None:
        now = time.monotonic()
        if now < self._publish_due:
            return
        self._publish_due = now + PUBLISH_S
        send(self._publisher, Envelope(dashboard_state(self.state), {}, "coordinator"))
