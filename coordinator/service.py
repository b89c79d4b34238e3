"""The coordinator's sockets and clock around its state machine."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

from coordinator.checkpointing import StateCheckpointing, resume_state
from coordinator.endpoints import Access, BoundSockets
from coordinator.error_boundary import ErrorBoundary
from coordinator.events import Action, Event, Finish, Interrupted, KeysChanged, LogRequest, Received, Send, Tick
from coordinator.finishing import retry_pauses, write_result
from coordinator.run_logger import RunLogger
from coordinator.snapshot import dashboard_state, status
from coordinator.state import CoordinatorState
from coordinator.worker_commands import WorkerCommands
from t4nmtd_dist.core.errors import ProtocolError, RunError
from t4nmtd_dist.process.memory import MemoryTrimmer
from t4nmtd_dist.runs.directory import RunDirectory
from t4nmtd_dist.runs.event_files import TensorBoard
from t4nmtd_dist.runs.resuming import CHECKPOINT_EVERY_S, Identity, write_identity
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.fields import shortened
from t4nmtd_dist.wire.messages import Failure, StatusRequest
from t4nmtd_dist.wire.secure_receiver import Arrival

TICK_S = 0.1
PUBLISH_S = 0.2
FAREWELL_S = 1.5
HURRIED_FAREWELL_S = 4.0
LONGEST_FAREWELL_S = 12.0  # a learner hears of the end only after a turn; `t4nmtd train` waits 15 s


@dataclass(frozen=True)
class RunStorage:
    """Storage settings of a run.

    Attributes:
        directory: the run directory; created once the endpoints are bound.
        restart: delete the run in the directory.
        resume: continue the run in the directory.
        checkpoint_every_s: checkpoint interval in seconds.
    """

    directory: Path
    restart: bool = False
    resume: bool = False
    checkpoint_every_s: float = CHECKPOINT_EVERY_S
    tensorboard: TensorBoard = "off"


class CoordinatorService:
    """Receives messages, drives the state machine, executes its actions, and publishes its state.

    Args:
        state: the state machine; on resume, a fresh one for the stored run.
        by_hand: whether users start the workers.

    Raises:
        ConfigError: if an endpoint cannot be used.
        KeyFileError: if the keys cannot be used.
        RunError: if the run directory cannot be used.
    """

    def __init__(self, state: CoordinatorState, storage: RunStorage, access: Access, *, by_hand: bool = False) -> None:
        self.state = state
        with ExitStack() as undo:
            self._sockets = BoundSockets(access)
            undo.callback(self._sockets.close)
            self._run = RunDirectory(storage.directory, restart=storage.restart, resume=storage.resume)
            self._run.lock()
            undo.pop_all()
        self.control, self.publish = self._sockets.control, self._sockets.publish
        self.own_keys = self._sockets.own_keys
        pids = state.task.decomposition.pids
        self.commands = WorkerCommands(pids, self.control, access.keys) if by_hand else None
        self._lines: SimpleQueue[str] = SimpleQueue()
        self._errors = ErrorBoundary(self._lines.put)
        self._publish_due = 0.0
        self._memory = MemoryTrimmer()
        self._interrupt: str | None = None
        self._over = threading.Event()
        self._interrupted = self._impatient = False
        self._open_run(storage)

    def _open_run(self, storage: RunStorage) -> None:
        """Restore a resumed run, and begin to write."""
        resumed = self._resume() if storage.resume else ""
        write_identity(self._run.path, Identity(self.state.settings.run_id, serial=False))
        self._checkpointing = StateCheckpointing(
            self.state, self._run.checkpoints, storage.checkpoint_every_s, self._lines.put
        )
        self._logger = RunLogger(self.state, self._run, storage.tensorboard, self._lines.put)
        self._run.write_endpoints(self.control, self.publish)
        if resumed:
            self._feed(LogRequest(time.monotonic(), resumed))

    def _resume(self) -> str:
        """Restore the stored run; returns a line naming the source."""
        resumed = resume_state(self.state, self._run.checkpoints, self._lines.put)
        self._run.mend(self.state.elapsed_s)
        return resumed

    def interrupt(self, reason: str) -> None:
        """End the run, or hurry if called again; safe from signal handlers and threads."""
        if self._interrupted or self._over.is_set():
            self._impatient = True
        self._interrupted = True
        self._interrupt = reason

    def serve(self) -> None:
        """Run until the state machine finishes, then briefly announce the end."""
        if self.state.outcome is not None:  # solved before the resume, but without a result
            self._logger.record(Finish(self.state.outcome, "before it was resumed"))
            self._over.set()
        try:
            while not self._over.is_set():
                self._turn()
            self._say_farewell()
        finally:
            self._sockets.close()
            self._run.unlock()

    def _say_farewell(self) -> None:
        """Announce the end, receive last reports, and write the result."""
        began = time.monotonic()
        while time.monotonic() < began + self._farewell_s():
            self._turn()
        self._report_missing()
        pause = retry_pauses(self._turn, lambda: self._impatient)
        try:
            with self._errors.guard("writing the result") as caught:
                write_result(self._logger, self._checkpointing, self._say, pause)
        finally:
            self._log_lines()
        if caught:
            raise RunError(
                f"the result could not be written; go on from the last checkpoint by --resume {self._run.path}"
            )

    def _say(self, text: str) -> None:
        self._feed(LogRequest(time.monotonic(), text))
        print(f"t4nmtd-coordinator: {text}", file=sys.stderr, flush=True)

    def _log_lines(self) -> None:
        while not self._lines.empty():
            self._feed(LogRequest(time.monotonic(), self._lines.get()))

    def _farewell_s(self) -> float:
        """Seconds to wait for last reports, by active learners and the user's hurry."""
        if not self.state.leases.holders(time.monotonic()):
            return FAREWELL_S
        return HURRIED_FAREWELL_S if self._impatient else LONGEST_FAREWELL_S

    def _report_missing(self) -> None:
        missing = [lease.place for lease in self.state.leases.all() if not lease.released]
        if missing:
            self._say(
                f"no last word of {', '.join(missing)}: what was done there since the last report is not counted "
                "here; a resume counts what its checkpoint holds"
            )

    def _turn(self) -> None:
        messages, subscriptions = self._sockets.wait(TICK_S)
        self._check_keys()
        if messages:
            for arrival in self._sockets.arrivals():
                self._take(arrival)
        if subscriptions and self._sockets.subscribed():
            self._publish_due = 0.0
        if self._interrupt is not None:
            self._feed(Interrupted(time.monotonic(), self._interrupt))
            self._interrupt = None
        self._feed(Tick(time.monotonic()))
        with self._errors.guard("publishing the state"):
            self._publish_state()
        if not self._over.is_set():
            self._write_down()

    def _write_down(self) -> None:
        with self._errors.guard("recording metrics"):
            self._logger.metrics()
        with self._errors.guard("keeping a checkpoint"):
            self._checkpointing.turn()
        self._log_lines()

    def _check_keys(self) -> None:
        allowed = self._sockets.changed_keys()
        if allowed is not None:
            self._feed(KeysChanged(time.monotonic(), allowed))
        for text in self._sockets.notices():
            self._feed(LogRequest(time.monotonic(), text))

    def _take(self, arrival: Arrival) -> None:
        peer, content = arrival.peer, arrival.content
        if isinstance(content, ProtocolError):
            self._sockets.answer(peer, Envelope(Failure(text=shortened(str(content)))))
            return
        with self._answered(peer, content):
            if isinstance(content.message, StatusRequest):
                answer = status(self.state, time.time(), self.commands)
                self._sockets.answer(peer, Envelope(answer, {}, "coordinator", content.id))
            else:
                self._follow(Received(time.monotonic(), peer, content, arrival.key))

    @contextmanager
    def _answered(self, peer: bytes, question: Envelope) -> Iterator[None]:
        """Log a failure to handle a message, and answer its sender."""
        what = f"taking {type(question.message).__name__} of {question.sender or 'a client'}"
        with self._errors.guard(what) as caught:
            yield
        if caught:
            text = f"the coordinator failed at {what}; its log says why"
            self._sockets.answer(peer, Envelope(Failure(text=shortened(text)), {}, "coordinator", question.id))

    def _feed(self, event: Event) -> None:
        with self._errors.guard(f"following {type(event).__name__}"):
            self._follow(event)

    def _follow(self, event: Event) -> None:
        for action in self.state.handle(event):
            self._carry_out(action)

    def _carry_out(self, action: Action) -> None:
        if isinstance(action, Send):
            envelope = Envelope(action.message, action.arrays, "coordinator", action.answers)
            self._sockets.answer(action.peer, envelope)
            return
        if isinstance(action, Finish):
            self._publish_due = 0.0
            self._over.set()
        with self._errors.guard("recording"):
            self._logger.record(action)

    def _publish_state(self) -> None:
        now = time.monotonic()
        if now < self._publish_due:
            return
        self._publish_due = now + PUBLISH_S
        self._memory.turn()
        self._sockets.broadcast(Envelope(dashboard_state(self.state, self.commands), {}, "coordinator"))
