"""All roles in lock-step in one process: bit-reproducible from a seed; for debugging, and the tests' oracle.

It uses the distributed system's own states, learners and messages, without the network.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import torch

from coordinator.events import Action, Event, Finish, Interrupted, LogEvent, Received, RecordEvaluation, Send
from coordinator.run_settings import RunSettings
from coordinator.saved_state import load_saved_state, saved_state
from coordinator.state import CoordinatorState
from t4nmtd_dist.agents.common.peer_values import InterventionCounts, LocalPeers, NoPeers, PeerCritics
from t4nmtd_dist.agents.weights import Weights
from t4nmtd_dist.core.devices import Device
from t4nmtd_dist.core.errors import LeaseError
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import Claim, EvaluationJob, EvaluationPoll, Granted, Message, Refused
from workers.evaluation_session import EvaluationSession
from workers.learner_session import LearnerSession


@dataclass
class SerialRun:
    """A training run in one process.

    Args:
        settings: seed and budget.
        clock: seconds; for display, never for decisions.
        device: device of all networks.
        transferred: networks that sub-tasks begin with.
    """

    task: CompiledTask
    settings: RunSettings
    clock: Callable[[], float]
    device: Device = "cpu"
    transferred: Mapping[str, Weights] = field(default_factory=dict)

    def __post_init__(self) -> None:
        torch.set_num_threads(1)
        self.coordinator = CoordinatorState(self.task, self.settings, self.transferred)
        self.sessions = {pid: self._begin(pid) for pid in self.task.decomposition.pids}
        experiences = {
            pid: s.learner.replay_buffer for pid, s in self.sessions.items() if s.learner.replay_buffer is not None
        }
        for session in self.sessions.values():
            session.learner.learn_from(experiences)
        self.evaluator = EvaluationSession(self._claim(Claim(role="evaluator", instance="serial"))[0])
        self.peers: dict[str, PeerCritics] = {pid: self._peers(pid) for pid in self.sessions}
        self.notes: list[Action] = []
        self._next = 0  # index of the next sub-task in this round

    def _begin(self, pid: str) -> LearnerSession:
        granted, envelope = self._claim(Claim(role="learner", instance="serial", pid=pid))
        return LearnerSession(granted, envelope.arrays, device=self.device)

    def _claim(self, claim: Claim) -> tuple[Granted, Envelope]:
        for envelope in self._ask(claim, {}):
            if isinstance(envelope.message, Granted):
                return envelope.message, envelope
            if isinstance(envelope.message, Refused):
                raise LeaseError(envelope.message.text)
        raise LeaseError("the coordinator did not answer a claim")

    def _peers(self, pid: str) -> PeerCritics:
        if self.task.config.learner.intervention == "off":
            return NoPeers()
        others = {other: s.learner.critic_values for other, s in self.sessions.items() if other != pid}
        return LocalPeers(others)

    def _handle(self, event: Event) -> list[Action]:
        actions = self.coordinator.handle(event)
        if hasattr(self, "notes"):
            self.notes += [action for action in actions if isinstance(action, LogEvent | RecordEvaluation | Finish)]
        return actions

    def _ask(self, message: Message, arrays: dict[str, object]) -> list[Envelope]:
        envelope = Envelope(message, arrays)  # type: ignore[arg-type]
        actions = self._handle(Received(self.clock(), b"serial", envelope))
        return [Envelope(a.message, a.arrays) for a in actions if isinstance(a, Send)]

    def steps(self) -> Iterator[list[Action]]:
        """Run rounds until the task is solved or the budget spent; yields the actions to record.

        In a round every learner that can start trains on one rollout, reports it and receives the reply. Then the
        evaluator polls for a job.
        """
        while self.coordinator.outcome is None:
            self.round()
            yield self.take_notes()

    def take_notes(self) -> list[Action]:
        """The actions to record since the last call."""
        taken, self.notes = self.notes, []
        return taken

    def state_dict(self) -> State:
        """The state for a checkpoint; arrays may be views of live data."""
        return {
            "coordinator": saved_state(self.coordinator),
            "sessions": {pid: session.state_dict() for pid, session in self.sessions.items()},
            "evaluator": self.evaluator.state_dict(),
            "next": self._next,
        }

    def load_state_dict(self, state: State) -> None:
        """Restore a ``state_dict`` of the same run; training then continues identically."""
        load_saved_state(self.coordinator, state["coordinator"])
        for pid, session in self.sessions.items():
            session.load_state_dict(state["sessions"][pid])
            self._load_counts(pid, state["sessions"][pid])
        self.evaluator.load_state_dict(state["evaluator"])
        self._next = state["next"]

    def _load_counts(self, pid: str, session: State) -> None:
        """Restore the query counts; open questions are asked again."""
        open_rows = sum(len(drawn["asked_rows"]) for drawn in session["learner"].get("ahead", ()))
        counts = InterventionCounts(**session["counts"])
        peers = self.peers[pid]
        if isinstance(peers, LocalPeers):
            counts.asked -= open_rows
            peers.counts = counts

    def stop(self, reason: str) -> None:
        """End the run now."""
        self._handle(Interrupted(self.clock(), reason))

    def round(self) -> None:
        """Run one round of all learners and the evaluator, or the rest of a resumed one."""
        for pid in list(self.sessions)[self._next :]:
            session = self.sessions[pid]
            session.iterate(self.peers[pid])
            self._sync(session)
            self._next += 1
            if self.coordinator.outcome is not None:
                return
        self._next = 0
        self._evaluate()

    def _sync(self, session: LearnerSession) -> None:
        sync = session.next_sync(float("inf"), 0.0)
        assert sync is not None
        actions = self._handle(Received(self.clock(), b"serial", sync))
        for action in actions:
            if isinstance(action, Send):
                session.take_reply(Envelope(action.message, action.arrays))

    def _evaluate(self) -> None:
        for envelope in self._ask(EvaluationPoll(epoch=self.evaluator.epoch), {}):
            if isinstance(envelope.message, EvaluationJob) and envelope.message.job:
                self._ask(self.evaluator.evaluate(envelope), {})
