"""The coordinator's sockets and clock around its state machine."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from pathlib import Path

from coordinator.doors import Access, Doors
from coordinator.events import Event, Finish, Interrupted, KeysChanged, Noticed, Received, Send, Tick
from coordinator.recorder import Recorder
from coordinator.snapshot import dashboard_state, status
from coordinator.state import CoordinatorState
from t4nmtd_dist.errors import ProtocolError
from t4nmtd_dist.runs.directory import RunDirectory
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.gate import Arrival
from t4nmtd_dist.wire.messages import Failure, StatusRequest

TICK_S = 0.1
PUBLISH_S = 0.2
FAREWELL_S = 1.5


class CoordinatorService:
    """Listens, feeds the state machine, carries out its actions, and publishes its state.

    Args:
        state: the state machine.
        directory: the run directory; made only once the endpoints are taken.
        access: where workers are heard, where the state is published, and for whom.
        restart: delete a run that the directory holds.

    Raises:
        ConfigError: if an endpoint cannot be used.
        KeyFileError: if the keys cannot be used.
        RunError: if the run directory cannot be used.
    """

    def __init__(self, state: CoordinatorState, directory: Path, access: Access, *, restart: bool = False) -> None:
        self.state = state
        with ExitStack() as undo:
            self._doors = Doors(access)
            undo.callback(self._doors.close)
            run = RunDirectory(directory, restart=restart)
            undo.pop_all()
        self.control, self.publish = self._doors.control, self._doors.publish
        self.own_keys = self._doors.own_keys
        self._recorder = Recorder(state, run)
        run.write_endpoints(self.control, self.publish)
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
            self._doors.close()

    def _turn(self) -> None:
        messages, subscriptions = self._doors.wait(TICK_S)
        self._check_keys()
        if messages:
            for arrival in self._doors.arrivals():
                self._take(arrival)
        if subscriptions and self._doors.subscribed():
            self._publish_due = 0.0
        if self._interrupt is not None:
            self._feed(Interrupted(time.monotonic(), self._interrupt))
            self._interrupt = None
        self._feed(Tick(time.monotonic()))
        self._publish_state()
        if not self._over.is_set():
            self._recorder.metrics()

    def _check_keys(self) -> None:
        allowed = self._doors.changed_keys()
        if allowed is not None:
            self._feed(KeysChanged(time.monotonic(), allowed))
        for text in self._doors.notices():
            self._feed(Noticed(time.monotonic(), text))

    def _take(self, arrival: Arrival) -> None:
        peer, content = arrival.peer, arrival.content
        if isinstance(content, ProtocolError):
            self._doors.answer(peer, Envelope(Failure(text=str(content))))
        elif isinstance(content.message, StatusRequest):
            self._doors.answer(peer, Envelope(status(self.state, time.time()), {}, "coordinator", content.id))
        else:
            self._feed(Received(time.monotonic(), peer, content, arrival.key))

    def _feed(self, event: Event) -> None:
        for action in self.state.handle(event):
            if isinstance(action, Send):
                envelope = Envelope(action.message, action.arrays, "coordinator", action.answers)
                self._doors.answer(action.peer, envelope)
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
        self._doors.broadcast(Envelope(dashboard_state(self.state), {}, "coordinator"))
