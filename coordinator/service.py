"""The coordinator's sockets and clock around its state machine."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from queue import SimpleQueue

from coordinator.checkpointing import StateKeeper, go_on
from coordinator.endpoints import Access, Doors
from coordinator.events import Action, Event, Finish, Interrupted, KeysChanged, Noticed, Received, Send, Tick
from coordinator.finishing import patience, write_result
from coordinator.mishaps import Mishaps
from coordinator.run_logger import Recorder
from coordinator.snapshot import dashboard_state, status
from coordinator.state import CoordinatorState
from coordinator.worker_commands import WorkerCommands
from t4nmtd_dist.core.errors import ProtocolError, RunError
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
LONGEST_FAREWELL_S = 12.0  # a learner hears of the end after a turn, which may take long; `t4nmtd train` waits 15 s


class CoordinatorService:
    """Listens, feeds the state machine, carries out its actions, and publishes its state.

    Args:
        state: the state machine.
        directory: the run directory; made only once the endpoints are taken.
        access: where workers are heard, where the state is published, and for whom.
        restart: delete a run that the directory holds.
        resume: go on with the run that the directory holds; ``state`` must be fresh and of that run.
        checkpoint_every_s: seconds between two checkpoints.
        tensorboard: whether to write event files for TensorBoard, too.
        by_hand: whether people start the workers, who want to be told the commands.

    Raises:
        ConfigError: if an endpoint cannot be used.
        KeyFileError: if the keys cannot be used.
        RunError: if the run directory cannot be used.
    """

    def __init__(
        self,
        state: CoordinatorState,
        directory: Path,
        access: Access,
        *,
        restart: bool = False,
        resume: bool = False,
        checkpoint_every_s: float = CHECKPOINT_EVERY_S,
        tensorboard: TensorBoard = "off",
        by_hand: bool = False,
    ) -> None:
        self.state = state
        with ExitStack() as undo:
            self._doors = Doors(access)
            undo.callback(self._doors.close)
            run = RunDirectory(directory, restart=restart, resume=resume)
            run.lock()
            undo.pop_all()
        self.control, self.publish = self._doors.control, self._doors.publish
        self.own_keys = self._doors.own_keys
        pids = state.task.decomposition.pids
        self.commands = WorkerCommands(pids, self.control, access.keys) if by_hand else None
        self._run = run
        self._said: SimpleQueue[str] = SimpleQueue()
        self._mishaps = Mishaps(self._said.put)
        resumed = self._go_on() if resume else ""
        write_identity(run.path, Identity(state.settings.run_id, serial=False))
        self._keeper = StateKeeper(state, run.checkpoints, checkpoint_every_s, self._said.put)
        self._recorder = Recorder(state, run, tensorboard, self._said.put)
        run.write_endpoints(self.control, self.publish)
        self._publish_due = 0.0
        self._interrupt: str | None = None
        self._over = threading.Event()
        self._impatient = False
        if resumed:
            self._feed(Noticed(time.monotonic(), resumed))

    def _go_on(self) -> str:
        """Load what the run has kept; what that was, in words."""
        told = go_on(self.state, self._run.checkpoints, self._said.put)
        self._run.mend(self.state.elapsed_s)
        return told

    def interrupt(self, reason: str) -> None:
        """Ask the loop to end the run; callable from a signal handler or another thread."""
        self._interrupt = reason
        if self._over.is_set():
            self._impatient = True

    def serve(self) -> None:
        """Run until the state machine finishes, then tell latecomers for a moment that it is over."""
        if self.state.outcome is not None:  # solved before the resume, and not written down
            self._recorder.record(Finish(self.state.outcome, "before it was resumed"))
            self._over.set()
        try:
            while not self._over.is_set():
                self._turn()
            self._say_farewell()
        finally:
            self._doors.close()
            self._run.unlock()

    def _say_farewell(self) -> None:
        """Tell all that it is over, hear what learners have done until they heard of it, and write everything down."""
        began = time.monotonic()
        while time.monotonic() < began + self._farewell_s():
            self._turn()
        self._tell_of_unheard()
        pause = patience(self._turn, lambda: self._impatient)
        try:
            with self._mishaps.survived("writing the result") as mishap:
                write_result(self._recorder, self._keeper, self._say, pause)
        finally:
            self._hear_keeper()
        if mishap:
            raise RunError(
                f"the result could not be written; go on from the last checkpoint by --resume {self._run.path}"
            )

    def _say(self, text: str) -> None:
        self._feed(Noticed(time.monotonic(), text))
        print(f"t4nmtd-coordinator: {text}", file=sys.stderr, flush=True)

    def _hear_keeper(self) -> None:
        while not self._said.empty():
            self._feed(Noticed(time.monotonic(), self._said.get()))

    def _farewell_s(self) -> float:
        """How long to wait for last words: as long as learners are at work, if nobody is in a hurry."""
        if not self.state.leases.holders(time.monotonic()):
            return FAREWELL_S
        return HURRIED_FAREWELL_S if self._impatient else LONGEST_FAREWELL_S

    def _tell_of_unheard(self) -> None:
        unheard = [lease.place for lease in self.state.leases.all() if not lease.released]
        if unheard:
            self._say(
                f"no last word of {', '.join(unheard)}: what was done there since the last report is not counted "
                "here; a resume counts what its checkpoint holds"
            )

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
        with self._mishaps.survived("publishing the state"):
            self._publish_state()
        if not self._over.is_set():
            self._write_down()

    def _write_down(self) -> None:
        with self._mishaps.survived("recording metrics"):
            self._recorder.metrics()
        with self._mishaps.survived("keeping a checkpoint"):
            self._keeper.turn()
        self._hear_keeper()

    def _check_keys(self) -> None:
        allowed = self._doors.changed_keys()
        if allowed is not None:
            self._feed(KeysChanged(time.monotonic(), allowed))
        for text in self._doors.notices():
            self._feed(Noticed(time.monotonic(), text))

    def _take(self, arrival: Arrival) -> None:
        peer, content = arrival.peer, arrival.content
        if isinstance(content, ProtocolError):
            self._doors.answer(peer, Envelope(Failure(text=shortened(str(content)))))
            return
        with self._answered(peer, content):
            if isinstance(content.message, StatusRequest):
                told = status(self.state, time.time(), self.commands)
                self._doors.answer(peer, Envelope(told, {}, "coordinator", content.id))
            else:
                self._follow(Received(time.monotonic(), peer, content, arrival.key))

    @contextmanager
    def _answered(self, peer: bytes, question: Envelope) -> Iterator[None]:
        """If taking a message fails, say so and tell its sender: it must not wait, and others must be heard."""
        what = f"taking {type(question.message).__name__} of {question.sender or 'a client'}"
        with self._mishaps.survived(what) as mishap:
            yield
        if mishap:
            text = f"the coordinator failed at {what}; its log says why"
            self._doors.answer(peer, Envelope(Failure(text=shortened(text)), {}, "coordinator", question.id))

    def _feed(self, event: Event) -> None:
        with self._mishaps.survived(f"following {type(event).__name__}"):
            self._follow(event)

    def _follow(self, event: Event) -> None:
        for action in self.state.handle(event):
            self._carry_out(action)

    def _carry_out(self, action: Action) -> None:
        if isinstance(action, Send):
            envelope = Envelope(action.message, action.arrays, "coordinator", action.answers)
            self._doors.answer(action.peer, envelope)
            return
        if isinstance(action, Finish):
            self._publish_due = 0.0
            self._over.set()
        with self._mishaps.survived("recording"):
            self._recorder.record(action)

    def _publish_state(self) -> None:
        now = time.monotonic()
        if now < self._publish_due:
            return
        self._publish_due = now + PUBLISH_S
        self._doors.broadcast(Envelope(dashboard_state(self.state, self.commands), {}, "coordinator"))
