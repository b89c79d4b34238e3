"""The worker process: one loop that learns (or evaluates), tells the coordinator, and hears its answers.

A place is claimed before torch and the environments are imported, which takes seconds: a refusal comes at once.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from t4nmtd_dist.core.errors import ProtocolError
from t4nmtd_dist.process.signals import install_signal_handlers
from t4nmtd_dist.wire.addresses import critic_endpoints
from t4nmtd_dist.wire.auth.handshake import HandshakeMonitor, trouble
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
from t4nmtd_dist.wire.sockets import connect, receive, send
from t4nmtd_dist.wire.zmq_types import new_context
from workers.critic_service import CriticService
from workers.evaluation_work import EvaluationWork
from workers.lazy_import import Loader, WaitingLease, check_trust
from workers.options import CheckpointOptions, WorkerOptions
from workers.peer_registry import Neighbours
from workers.stand_in import STAND_IN, StandIn
from workers.state import Action, Ask, Begin, End, Exit, GiveBack, Say, WorkerState

if TYPE_CHECKING:
    from workers.checkpointing import SessionKeeper
    from workers.learner_session import LearnerSession

SYNC_INTERVAL_S = 0.2
HEARTBEAT_S = 0.5
IDLE_POLL_S = 0.05
LONG_TURN_S = 2.0
LAST_ANSWERS_S = 5.0  # counts told but not answered are told again by a resume
STOPPED = 130


class Worker:
    """Holds leases and works under them until the run is over.

    Args:
        options: how it was started.

    Raises:
        ConfigError: if an endpoint cannot be used.
        KeyFileError: if the keys cannot be used.
    """

    def __init__(self, options: WorkerOptions) -> None:
        self._options, self._connection = options, options.connection
        self._context = new_context()
        self._keys = None if options.connection.keys is None else load_client(options.connection.keys)
        self._critics = self._serve_critics()
        self._control = connect(self._context, options.connection.coordinator, self._keys, monitored=True)
        self._handshakes = HandshakeMonitor(self._control)
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
        self._neighbours = Neighbours(self._context, options.instance, self._keys, tell=say)
        self._evaluation: EvaluationWork | None = None
        self._stand_in = StandIn(options.instance, lambda message: self._send(message, number=STAND_IN), say)
        self._waiting: dict[str, WaitingLease] = {}
        self._loader = Loader(options.role)
        self._keeper = None if options.checkpoints is None else self._keep(options.checkpoints)
        self._solved = False
        self._heartbeat_due = 0.0
        self._turn_began = self._last_syncs = time.monotonic()
        self._exit: Exit | None = None
        self._told: set[str] = set()
        self._interrupted = False

    def _keep(self, checkpoints: CheckpointOptions) -> SessionKeeper:
        from workers.checkpointing import SessionKeeper

        return SessionKeeper(checkpoints.folder, checkpoints.every_s, say)

    def _serve_critics(self) -> CriticService:
        address, connection = self._options.critic, self._connection
        endpoint, told = critic_endpoints(connection.coordinator, address.host, address.port, address.advertise)
        own = None if self._keys is None else self._keys.own
        return CriticService(self._context, endpoint, advertise=told, insecure=connection.insecure, own=own, tell=say)

    def run(self) -> int:
        """Work until the run is over (exit code 0), nothing can be done (2), or a signal says stop (130).

        Raises:
            TrustError: if the coordinator wants code to be run and may be anybody.
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

    def _interrupt(self, *_: object) -> None:
        self._interrupted = True

    def _end_work(self) -> None:
        """Tell the coordinator the rest, give everything back, and keep what was learned."""
        sessions = list(self._sessions.values())
        syncs = [session.last_sync() for session in sessions]
        sent = [self._send(sync.message, sync.arrays) for sync in syncs]
        self._give_back()
        if any(sent):
            self._hear_answers(sessions)
        if self._keeper is not None and self._solved:
            self._keeper.delete(sessions)
        elif self._keeper is not None:
            self._keeper.finish(sessions)

    def _hear_answers(self, sessions: Sequence[LearnerSession]) -> None:
        """Wait a moment for the answers to the last messages."""
        deadline = time.monotonic() + LAST_ANSWERS_S
        while (left := deadline - time.monotonic()) > 0 and not all(session.heard for session in sessions):
            try:
                envelope = receive(self._control, left)
            except ProtocolError:
                return
            for session in sessions:
                if envelope is not None and isinstance(envelope.message, SyncReply):
                    session.take_reply(envelope)

    def _turn(self) -> None:
        self._open_sessions()
        busy = self._evaluate() or (not self._stand_in.waiting and self._learn())
        self._watch_connection()
        self._hear(0.0 if busy else IDLE_POLL_S)
        now = time.monotonic()
        if self._waiting or now - self._turn_began > LONG_TURN_S:
            self._state.was_deaf(self._turn_began, now)
        self._turn_began = now
        self._act(self._state.tick(now), {})
        self._send_heartbeats(now)
        for session in self._sessions.values():
            sync = session.next_sync(now, SYNC_INTERVAL_S)
            if sync is not None:
                self._send(sync.message, sync.arrays)
        for evaluation in (self._evaluation, self._stand_in):
            if evaluation is not None:
                evaluation.tell()
        self._last_syncs = now
        if self._keeper is not None:
            self._keeper.turn(self._sessions.values())

    def _keep_leases(self) -> None:
        """Within a turn: a sign of life for every lease that would run out if this turn took much longer."""
        now = time.monotonic()
        if all(now < self._last_syncs + session.lease_s / 4 for session in self._sessions.values()):
            return
        self._last_syncs = now
        for session in self._sessions.values():
            self._send(session.heartbeat())

    def _watch_connection(self) -> None:
        """Give up when the coordinator will not talk to this worker; tell what else keeps a connection away, once."""
        while (outcome := self._handshakes.next()) is not None:
            text = trouble(outcome, self._connection.coordinator, self._keys)
            if text is not None and outcome != "broken":
                self._exit = Exit(2, text)
            elif text is not None and text not in self._told:
                self._told.add(text)
                say(text)

    def _evaluate(self) -> bool:
        """A slice of the evaluation under way, be it this worker's work or between its learners' turns."""
        if self._evaluation is None or not self._evaluation.busy:
            return self._stand_in.turn()
        self._evaluation.advance()
        return True

    def _learn(self) -> bool:
        """One roll-out of every learner that can start; False if none can."""
        self._neighbours.pull_experience()
        trained = []
        for pid, session in self._sessions.items():
            began = time.process_time()
            trained.append(session.iterate(self._neighbours.peers[pid]))
            session.processor_s += time.process_time() - began
        return any(trained)

    def _send(self, message: Message, arrays: Mapping[str, NDArray[Any]] | None = None, *, number: int = 0) -> bool:
        return send(self._control, Envelope(message, arrays or {}, self._options.instance, number))

    def _hear(self, timeout_s: float) -> None:
        while self._exit is None:
            try:
                envelope = receive(self._control, timeout_s)
            except ProtocolError as error:
                self._exit = Exit(2, f"{self._connection.coordinator} does not speak this protocol: {error}")
                return
            if envelope is None:
                return
            timeout_s = 0.0
            self._take(envelope)

    def _take(self, envelope: Envelope) -> None:
        message = envelope.message
        if envelope.id == STAND_IN and isinstance(message, Granted | Refused | EvaluationJob | Failure):
            if isinstance(message, Granted):
                self._check_trust(message)
            self._stand_in.take(envelope)
            return
        self._act(self._state.hear(time.monotonic(), message), envelope.arrays)
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
        self._neighbours.locate(session)
        self._critics.allow(peer.key for held in self._sessions.values() for peer in held.peers.values())

    def _act(self, actions: Sequence[Action], arrays: Mapping[str, NDArray[Any]]) -> None:
        for action in actions:
            if isinstance(action, Ask):
                self._send(action.claim)
            elif isinstance(action, Begin):
                self._begin(action.granted, arrays)
            elif isinstance(action, End):
                self._end(action.pid)
                say(action.reason)
            elif isinstance(action, GiveBack):
                self._send(Release(pid=action.granted.pid, epoch=action.granted.epoch))
            elif isinstance(action, Say):
                say(action.text)
            else:
                self._exit = action

    def _begin(self, granted: Granted, arrays: Mapping[str, NDArray[Any]]) -> None:
        held = self._sessions.get(granted.pid)
        if held is not None and held.goes_on_in(granted):
            held.renew(granted)
            return
        if granted.role == "learner":
            self._end_those_of_another_training(granted)
        self._waiting[granted.pid] = WaitingLease(granted, arrays)
        self._check_trust(granted)

    def _check_trust(self, granted: Granted) -> None:
        if self._keys is None:
            check_trust(granted, self._connection.coordinator, given=self._connection.trust)

    def _end_those_of_another_training(self, granted: Granted) -> None:
        """Learners that outlived their coordinator are of no use to one that trains something else."""
        for pid, session in list(self._sessions.items()):
            if not session.goes_on_in(granted):
                say(f"{pid} is over here: the coordinator trains another task now, or with another seed or settings")
                self._end(pid)
                if pid != granted.pid:
                    self._state.forget(pid, time.monotonic())

    def _open_sessions(self) -> None:
        """Start work under the leases that wait for it, as soon as everything is loaded."""
        if not self._waiting or not self._loader.ready():
            return
        for pid, lease in self._waiting.items():
            if lease.granted.role == "evaluator":
                self._evaluation = EvaluationWork(lease.evaluate(), self._send)
                continue
            session = lease.learn(self._options.device, say)
            if self._keeper is not None:
                self._keeper.go_on(session, lease.granted, lease.arrays)
            session.learner.rollout.pulse = self._keep_leases
            self._sessions[pid] = session
            self._neighbours.join(session)
            self._critics.serve(pid, session.learner.published, session.learner.experience)
        self._waiting.clear()

    def _send_heartbeats(self, now: float) -> None:
        """Keep the leases alive under which no work has begun yet."""
        if now < self._heartbeat_due:
            return
        self._heartbeat_due = now + HEARTBEAT_S
        for lease in self._waiting.values():
            if lease.granted.role == "learner":
                self._send(lease.heartbeat())

    def _end(self, pid: str) -> None:
        self._waiting.pop(pid, None)
        self._sessions.pop(pid, None)
        self._neighbours.leave(pid)

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
        self._neighbours.close()
        self._critics.close()
        self._handshakes.close()
        self._control.close(200)
        self._context.term()


def say(text: str) -> None:
    """One line for the person at the terminal, or in a log; where that is full, nobody hears it."""
    with suppress(OSError):
        print(f"t4nmtd-worker: {text}", file=sys.stderr, flush=True)
