"""The worker process: a loop that learns or evaluates, and talks to the coordinator.

It claims a place before importing torch and the environments, so that a refusal comes at once. A separate thread renews
its leases whatever the loop does.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Hashable, Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from t4nmtd_dist.core.errors import ProtocolError
from t4nmtd_dist.process.signals import install_signal_handlers
from t4nmtd_dist.wire.addresses import critic_endpoints
from t4nmtd_dist.wire.auth.handshake import Outcome, trouble
from t4nmtd_dist.wire.auth.keys import load_client
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import (
    EvaluationJob,
    Failure,
    Goodbye,
    Granted,
    Message,
    Refused,
    Release,
    SyncReply,
)
from t4nmtd_dist.wire.zmq_types import new_context
from workers.control_connection import Arrival, ControlConnection
from workers.critic_service import CriticService
from workers.evaluation_work import EvaluationWork
from workers.lazy_import import HeavyImports, WaitingLease, check_trust
from workers.loop_watch import LoopWatch, place_of
from workers.options import CheckpointOptions, WorkerOptions
from workers.peer_registry import PeerRegistry
from workers.say import say
from workers.stand_in import STAND_IN, StandIn
from workers.state import Action, Exit, Print, SendClaim, SendRelease, StartWork, StopWork, WorkerState

if TYPE_CHECKING:
    from workers.checkpointing import LearnerCheckpoints
    from workers.learner_session import LearnerSession

SYNC_INTERVAL_S = 0.2
IDLE_POLL_S = 0.05
LAST_SEND_S = 2.0
LAST_ANSWERS_S = 5.0  # a resume repeats counts that were reported but not answered
STOPPED = 130


class Worker:
    """Holds leases and works under them until the run is over.

    Raises:
        ConfigError: if an endpoint cannot be used.
        KeyFileError: if the keys cannot be used.
    """

    def __init__(self, options: WorkerOptions) -> None:
        self._options, self._connection = options, options.connection
        self._context = new_context()
        self._keys = None if options.connection.keys is None else load_client(options.connection.keys)
        self._critics = self._serve_critics()
        self._state = WorkerState(
            options.role,
            options.instance,
            options.pids,
            options.connection.coordinator,
            self._critics.endpoint,
            options.connection.wait_s,
            time.monotonic(),
        )
        self._sessions: dict[str, LearnerSession] = {}
        self._turns, self._loop_thread = 0, threading.get_ident()
        self._control = ControlConnection(
            self._context,
            options.connection.coordinator,
            options.instance,
            self._keys,
            LoopWatch(self, time.monotonic()),
        )
        self._peer_registry = PeerRegistry(self._context, options.instance, self._keys, tell=say)
        self._evaluation: EvaluationWork | None = None
        self._stand_in = StandIn(options.instance, lambda message: self._send(message, number=STAND_IN), say)
        self._waiting: dict[str, WaitingLease] = {}
        self._imports = HeavyImports(options.role)
        self._checkpoints = None if options.checkpoints is None else self._checkpoints_in(options.checkpoints)
        self._solved = False
        self._stopped_s = 0.0
        self._exit: Exit | None = None
        self._told: set[str] = set()
        self._interrupted = False

    def _checkpoints_in(self, checkpoints: CheckpointOptions) -> LearnerCheckpoints:
        from workers.checkpointing import LearnerCheckpoints

        return LearnerCheckpoints(checkpoints.folder, checkpoints.every_s, say)

    def _serve_critics(self) -> CriticService:
        address, connection = self._options.critic, self._connection
        endpoint, told = critic_endpoints(connection.coordinator, address.host, address.port, address.advertise)
        own = None if self._keys is None else self._keys.own
        return CriticService(self._context, endpoint, advertise=told, insecure=connection.insecure, own=own, tell=say)

    def run(self) -> int:
        """Work until the run is over (exit code 0), work is impossible (2), or a signal stops it (130).

        Raises:
            TrustError: if the coordinator has no keys and its task names untrusted code.
            EnvError: if the task's environment fails.
        """
        install_signal_handlers(self._interrupt)
        try:
            while self._exit is None and not self._interrupted:
                self._turn()
            self._end_work()
        finally:
            self._close()
        if self._exit is not None and self._exit.text:
            say(self._exit.text)
        return self._exit.code if self._exit is not None else STOPPED

    def name(self) -> str:
        """The held sub-tasks, or this worker's name; see ``Loop``."""
        return ", ".join(self._state.held) or self._options.instance

    def progress(self) -> Hashable:
        """Turns, environment steps and updates; see ``Loop``."""
        learners = [session.learner for session in list(self._sessions.values())]
        steps = sum(learner.rollout.interactions for learner in learners)
        return self._turns, steps, sum(learner.gradient_steps for learner in learners)

    def where(self) -> str:
        """The call the loop is in; see ``Loop``."""
        return place_of(self._loop_thread)

    def _interrupt(self, *_: object) -> None:
        self._interrupted = True

    def _end_work(self) -> None:
        """Report the rest, release all leases, and write last checkpoints."""
        sessions = list(self._sessions.values())
        syncs = [session.last_sync() for session in sessions]
        sent = [self._send(sync.message, sync.arrays) for sync in syncs]
        self._give_back()
        if any(map(_was_taken, sent)):
            self._hear_answers(sessions)
        if self._checkpoints is not None and self._solved:
            self._checkpoints.delete(sessions)
        elif self._checkpoints is not None:
            self._checkpoints.write_last(sessions)

    def _hear_answers(self, sessions: Sequence[LearnerSession]) -> None:
        """Wait briefly for the last replies."""
        deadline = time.monotonic() + LAST_ANSWERS_S
        while (left := deadline - time.monotonic()) > 0 and not all(session.is_answered for session in sessions):
            arrival = self._control.receive(left)
            if arrival is None or isinstance(arrival.content, ProtocolError):
                return
            envelope = arrival.content
            for session in sessions:
                if isinstance(envelope, Envelope) and isinstance(envelope.message, SyncReply) and not arrival.renewal:
                    session.take_reply(envelope)

    def _turn(self) -> None:
        self._turns, self._loop_thread = self._turns + 1, threading.get_ident()
        self._open_sessions()
        busy = self._evaluate() or (not self._stand_in.waiting and self._learn())
        self._hear(0.0 if busy else IDLE_POLL_S)
        now = time.monotonic()
        self._discount_stops(now)
        self._act(self._state.tick(now), {})
        for session in self._sessions.values():
            sync = session.next_sync(now, SYNC_INTERVAL_S)
            if sync is not None:
                self._send(sync.message, sync.arrays)
        for evaluation in (self._evaluation, self._stand_in):
            if evaluation is not None:
                evaluation.tell()
        if self._checkpoints is not None:
            self._checkpoints.write_due(self._sessions.values())

    def _discount_stops(self, now: float) -> None:
        """Do not count time this process was stopped as coordinator silence."""
        stopped_s = self._control.stopped_s()
        if stopped_s > self._stopped_s:
            self._state.discount_blocked_time(now - (stopped_s - self._stopped_s), now)
            self._stopped_s = stopped_s

    def _take_outcome(self, outcome: Outcome) -> None:
        """Give up if the coordinator rejects this worker; report other problems once."""
        text = trouble(outcome, self._connection.coordinator, self._keys)
        if text is not None and outcome != "broken":
            self._exit = Exit(2, text)
        elif text is not None and text not in self._told:
            self._told.add(text)
            say(text)

    def _evaluate(self) -> bool:
        """Run a slice of the evaluation."""
        if self._evaluation is None or not self._evaluation.busy:
            return self._stand_in.turn()
        self._evaluation.advance()
        return True

    def _learn(self) -> bool:
        """One rollout of every learner that can start; False if none can."""
        self._peer_registry.pull_experience()
        trained = []
        for pid, session in self._sessions.items():
            began = time.process_time()
            trained.append(session.iterate(self._peer_registry.peers[pid]))
            session.processor_s += time.process_time() - began
        return any(trained)

    def _send(
        self, message: Message, arrays: Mapping[str, NDArray[Any]] | None = None, *, number: int = 0
    ) -> Future[bool]:
        return self._control.send(Envelope(message, arrays or {}, self._options.instance, number))

    def _hear(self, timeout_s: float) -> None:
        while self._exit is None:
            arrival = self._control.receive(timeout_s)
            if arrival is None:
                return
            timeout_s = 0.0
            self._take_arrival(arrival)

    def _take_arrival(self, arrival: Arrival) -> None:
        content = arrival.content
        if isinstance(content, ProtocolError):
            self._exit = Exit(2, f"{self._connection.coordinator} does not speak this protocol: {content}")
        elif not isinstance(content, Envelope):
            self._take_outcome(content)
        elif arrival.renewal:
            self._state.receive(arrival.at, content.message)
        else:
            self._take(content, arrival.at)

    def _take(self, envelope: Envelope, at: float) -> None:
        message = envelope.message
        if envelope.id == STAND_IN and isinstance(message, Granted | Refused | EvaluationJob | Failure):
            if isinstance(message, Granted):
                self._check_trust(message)
            self._stand_in.take(envelope)
            return
        self._act(self._state.receive(at, message), envelope.arrays)
        if isinstance(message, SyncReply):
            self._take_reply(message, envelope)
        elif isinstance(message, EvaluationJob) and self._evaluation is not None:
            self._evaluation.take(envelope)
        elif isinstance(message, Refused) and message.reason == "stale epoch" and self._options.role == "evaluator":
            self._evaluation = None
        elif isinstance(message, Goodbye):
            self._solved = message.reason == "solved"
        elif isinstance(message, Failure):
            self._exit = Exit(2, f"the coordinator refused a message: {message.text}")

    def _take_reply(self, reply: SyncReply, envelope: Envelope) -> None:
        session = self._sessions.get(reply.pid)
        if session is None:
            return
        if reply.evaluate:
            self._stand_in.invited()
        session.take_reply(envelope)
        self._peer_registry.locate(session)
        self._critics.allow(peer.key for held in self._sessions.values() for peer in held.peers.values())

    def _act(self, actions: Sequence[Action], arrays: Mapping[str, NDArray[Any]]) -> None:
        for action in actions:
            if isinstance(action, SendClaim):
                self._send(action.claim)
            elif isinstance(action, StartWork):
                self._begin(action.granted, arrays)
            elif isinstance(action, StopWork):
                self._end(action.pid)
                say(action.reason)
            elif isinstance(action, SendRelease):
                self._send(Release(pid=action.granted.pid, epoch=action.granted.epoch))
            elif isinstance(action, Print):
                say(action.text)
            else:
                self._exit = action

    def _begin(self, granted: Granted, arrays: Mapping[str, NDArray[Any]]) -> None:
        held = self._sessions.get(granted.pid)
        if held is not None and held.can_go_on_under(granted):
            held.renew(granted)
            return
        if granted.role == "learner":
            self._end_those_of_another_training(granted)
        self._waiting[granted.pid] = waiting = WaitingLease(granted, arrays)
        self._check_trust(granted)
        self._send(waiting.first_message())

    def _check_trust(self, granted: Granted) -> None:
        if self._keys is None:
            check_trust(granted, self._connection.coordinator, given=self._connection.trust)

    def _end_those_of_another_training(self, granted: Granted) -> None:
        """End kept learners that the new training cannot use."""
        for pid, session in list(self._sessions.items()):
            if not session.can_go_on_under(granted):
                say(f"{pid} is over here: the coordinator trains another task now, or with another seed or settings")
                self._end(pid)
                if pid != granted.pid:
                    self._state.forget(pid, time.monotonic())

    def _open_sessions(self) -> None:
        """Start work under waiting leases once imported."""
        if not self._waiting or not self._imports.ready():
            return
        for pid, lease in self._waiting.items():
            if lease.granted.role == "evaluator":
                self._evaluation = EvaluationWork(lease.evaluate(), self._send)
                continue
            session = lease.learn(self._options.device, say)
            if self._checkpoints is not None:
                self._checkpoints.resume(session, lease.granted, lease.arrays)
            self._sessions[pid] = session
            self._peer_registry.join(session)
            self._critics.serve(pid, session.learner.published, session.learner.replay_buffer)
        self._waiting.clear()

    def _end(self, pid: str) -> None:
        self._control.forget(pid)
        self._waiting.pop(pid, None)
        self._sessions.pop(pid, None)
        self._peer_registry.leave(pid)

    def _give_back(self) -> None:
        epochs = {pid: session.epoch for pid, session in self._sessions.items()}
        epochs |= {pid: lease.granted.epoch for pid, lease in self._waiting.items()}
        for pid, epoch in epochs.items():
            self._send(Release(pid=pid, epoch=epoch))
            self._end(pid)
        if self._evaluation is not None:
            self._evaluation.give_back()
            self._evaluation = None
        self._stand_in.close()

    def _close(self) -> None:
        self._give_back()
        self._peer_registry.close()
        self._critics.close()
        self._control.close()
        self._context.term()


def _was_taken(sent: Future[bool]) -> bool:
    """Whether a message was sent; waits briefly for it."""
    try:
        return sent.result(LAST_SEND_S)
    except FutureTimeoutError:
        return False
