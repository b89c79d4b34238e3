"""The worker process: one loop that learns (or evaluates), tells the coordinator, and hears its answers."""

from __future__ import annotations

import os
import signal
import socket as hostnames
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from t4nmtd_dist.errors import ProtocolError
from t4nmtd_dist.learners.peers import LocalPeers, NoPeers, PeerCritics
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.critic_client import QueryPeers
from t4nmtd_dist.wire.messages import (
    EvaluationJob,
    EvaluationPoll,
    Failure,
    Granted,
    Message,
    Refused,
    Release,
    Role,
    SyncReply,
)
from t4nmtd_dist.wire.sockets import connect, new_context, receive, send
from workers.critic_service import CriticService
from workers.evaluation_session import EvaluationSession
from workers.learner_session import LearnerSession
from workers.state import Action, Ask, Begin, End, Exit, Say, WorkerState

SYNC_INTERVAL_S = 0.2
IDLE_POLL_S = 0.05
EVALUATION_POLL_S = 0.2
EVALUATION_PATIENCE_S = 3.0


@dataclass(frozen=True)
class WorkerOptions:
    """How a worker was started; see ``t4nmtd-worker --help``."""

    coordinator: str
    role: Role
    pids: Sequence[str]
    instance: str
    wait_s: float
    critic_host: str = "127.0.0.1"
    insecure: bool = False


def default_instance() -> str:
    """A name for this process: host and process number."""
    return f"{hostnames.gethostname()}:{os.getpid()}"


class Worker:
    """Holds leases and works under them until the run is over.

    Args:
        options: how it was started.
    """

    def __init__(self, options: WorkerOptions) -> None:
        self._options = options
        self._context = new_context()
        self._control = connect(self._context, options.coordinator)
        self._critics = CriticService(self._context, options.critic_host, insecure=options.insecure)
        self._state = WorkerState(
            options.role,
            options.instance,
            options.pids,
            options.coordinator,
            self._critics.endpoint,
            options.wait_s,
            time.monotonic(),
        )
        self._sessions: dict[str, LearnerSession] = {}
        self._peers: dict[str, QueryPeers | LocalPeers | NoPeers] = {}
        self._evaluation: EvaluationSession | None = None
        self._poll_due = 0.0
        self._exit: Exit | None = None
        self._interrupted = False

    def run(self) -> int:
        """Work until the run is over or the process is told to stop; the exit code."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._interrupt)
        try:
            while self._exit is None and not self._interrupted:
                self._turn()
        finally:
            self._close()
        if self._exit is not None and self._exit.text:
            say(self._exit.text)
        return self._exit.code if self._exit is not None else 0

    def _interrupt(self, *_: object) -> None:
        self._interrupted = True

    def _turn(self) -> None:
        busy = self._learn()
        self._hear(0.0 if busy else IDLE_POLL_S)
        now = time.monotonic()
        self._act(self._state.tick(now), {})
        for session in self._sessions.values():
            sync = session.next_sync(now, SYNC_INTERVAL_S)
            if sync is not None:
                self._send(sync.message, sync.arrays)
        self._poll_evaluation(now)

    def _learn(self) -> bool:
        """One roll-out of every learner that can start; False if none can."""
        trained = [session.iterate(self._peers[pid]) for pid, session in self._sessions.items()]
        return any(trained)

    def _send(self, message: Message, arrays: Mapping[str, NDArray[Any]] | None = None) -> None:
        send(self._control, Envelope(message, arrays or {}, self._options.instance))

    def _hear(self, timeout_s: float) -> None:
        while self._exit is None:
            try:
                envelope = receive(self._control, timeout_s)
            except ProtocolError as error:
                self._exit = Exit(2, f"{self._options.coordinator} does not speak this protocol: {error}")
                return
            if envelope is None:
                return
            timeout_s = 0.0
            self._take(envelope)

    def _take(self, envelope: Envelope) -> None:
        message = envelope.message
        self._act(self._state.hear(time.monotonic(), message), envelope.arrays)
        if isinstance(message, SyncReply):
            self._take_reply(message, envelope)
        elif isinstance(message, EvaluationJob) and message.job and self._evaluation is not None:
            self._send(self._evaluation.evaluate(envelope))
            self._poll_due = 0.0
        elif isinstance(message, EvaluationJob):
            self._poll_due = time.monotonic() + EVALUATION_POLL_S
        elif isinstance(message, Refused) and message.reason == "stale epoch" and self._options.role == "evaluator":
            self._evaluation = None
        elif isinstance(message, Failure):
            self._exit = Exit(2, f"the coordinator refused a message: {message.text}")

    def _take_reply(self, reply: SyncReply, envelope: Envelope) -> None:
        session = self._sessions.get(reply.pid)
        if session is None:
            return
        session.take_reply(envelope)
        peers = self._peers[reply.pid]
        if isinstance(peers, QueryPeers):
            peers.set_peers(session.peers)

    def _poll_evaluation(self, now: float) -> None:
        if self._evaluation is not None and now >= self._poll_due:
            self._poll_due = now + EVALUATION_PATIENCE_S
            self._send(EvaluationPoll(epoch=self._evaluation.epoch))

    def _act(self, actions: Sequence[Action], arrays: Mapping[str, NDArray[Any]]) -> None:
        for action in actions:
            if isinstance(action, Ask):
                self._send(action.claim)
            elif isinstance(action, Begin):
                self._begin(action.granted, arrays)
            elif isinstance(action, End):
                self._end(action.pid)
                say(action.reason)
            elif isinstance(action, Say):
                say(action.text)
            else:
                self._exit = action

    def _begin(self, granted: Granted, arrays: Mapping[str, NDArray[Any]]) -> None:
        if granted.role == "evaluator":
            self._evaluation = EvaluationSession(granted)
            return
        held = self._sessions.get(granted.pid)
        if held is not None:
            held.renew(granted)
            return
        session = LearnerSession(granted, arrays)
        self._sessions[granted.pid] = session
        self._peers[granted.pid] = self._peers_of(session)
        self._critics.serve(granted.pid, session.learner.published)

    def _peers_of(self, session: LearnerSession) -> QueryPeers | LocalPeers | NoPeers:
        if session.intervention == "off":
            return NoPeers()
        return QueryPeers(self._context, f"{self._options.instance}/{session.pid}")

    def _end(self, pid: str) -> None:
        self._sessions.pop(pid, None)
        peers: PeerCritics | None = self._peers.pop(pid, None)
        if isinstance(peers, QueryPeers):
            peers.close()

    def _close(self) -> None:
        for pid, session in list(self._sessions.items()):
            self._send(Release(pid=pid, epoch=session.epoch))
            self._end(pid)
        self._critics.close()
        self._control.close(200)
        self._context.term()


def say(text: str) -> None:
    """One line for the person at the terminal."""
    print(f"t4nmtd-worker: {text}", file=sys.stderr, flush=True)
