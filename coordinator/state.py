"""The coordinator as a pure state machine (paper, Algorithm 1): events in, actions out; no sockets, no clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coordinator.checks import finite_figures
from coordinator.evaluator_duty import EvaluatorDuty
from coordinator.event_log import EVENTS_KEPT, EventLog, RunClock
from coordinator.events import (
    Action,
    Event,
    Finish,
    Interrupted,
    KeysChanged,
    LogRequest,
    Outcome,
    Received,
    RecordEvaluation,
    Send,
)
from coordinator.intake import Intake, usable
from coordinator.invariants import (
    check_evaluations,
    check_events,
    check_leases,
    check_q_table,
    check_records,
    check_stand_ins,
)
from coordinator.learner_registry import LearnerRecord, interactions, processor_s
from coordinator.leasing import Leasing
from coordinator.notice_filter import NoticeFilter
from coordinator.run_settings import RunSettings
from coordinator.stuck import StuckDetector
from t4nmtd_dist.core.errors import ProtocolError
from t4nmtd_dist.core.invariants import Monotone, require
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.runs.report import solved_text
from t4nmtd_dist.wire.codec import without_prefix
from t4nmtd_dist.wire.limits import most_starts
from t4nmtd_dist.wire.messages import (
    Claim,
    EvaluationPoll,
    EvaluationReport,
    EventLine,
    Failure,
    Goodbye,
    Message,
    Notice,
    Release,
    RunPhase,
    Sync,
    SyncReply,
)
from t4nmtd_dist.wire.progress import Start, pack_starts, unpack_progress

STARTS_PER_REPLY = 256


class CoordinatorState:
    """Owns the task, the Q-table, the initial-state buffers, the leases, the newest weights and the counters.

    Attributes:
        method: the rules of the method, with the table Q(q, sub-task).
        records: of each learner by pid, with its sub-task's initial-state buffer.
        leases: on the sub-tasks.
        evaluator_lease: on the evaluator role.
        snapshot: a received start state, if any: all of a run have the same dtype and size.
        outcome: how the run ended; None while it is running.
    """

    def __init__(
        self,
        task: CompiledTask,
        settings: RunSettings,
        transferred: Mapping[str, Mapping[str, NDArray[Any]]] | None = None,
    ) -> None:
        self.task, self.settings = task, settings
        self.method = task.method()
        self.rng = np.random.default_rng([settings.seed, 2])
        self.records = {pid: LearnerRecord(task.start_buffer()) for pid in task.decomposition.pids}
        self.clock = RunClock()
        self._log = EventLog(self.clock)
        self._leasing = Leasing(task, settings, self.records, self.clock, self._log)
        self.leases, self.evaluator_lease = self._leasing.learners, self._leasing.evaluator
        self.stand_ins = self._leasing.stand_ins
        self._evaluator = EvaluatorDuty(task, self.records, self.method, self._leasing, self.clock)
        self.evaluations = self._evaluator.schedule
        self._notice_filter, self._stuck, self._intake = NoticeFilter(), StuckDetector(), Intake(task)
        self.snapshot: NDArray[Any] | None = None
        self.outcome: Outcome | None = None
        self._growing = Monotone()
        for pid, weights in (transferred or {}).items():
            self.records[pid].version, self.records[pid].weights = 1, weights
        if transferred:
            self._log.add(f"{', '.join(transferred)}: begin with the networks of {settings.transfer_from}")

    @property
    def events(self) -> deque[EventLine]:
        """The newest lines of the event log."""
        return self._log.lines

    @property
    def elapsed_s(self) -> float:
        """Seconds from the first event to the end of the run, plus those before a resume."""
        return self.clock.elapsed_s

    @property
    def interactions(self) -> int:
        """Environment steps of all learners together, evaluation excluded."""
        return interactions(self.records)

    @property
    def learners_s(self) -> float:
        """CPU time of all learners in seconds."""
        return processor_s(self.records)

    @property
    def phase(self) -> RunPhase:
        """The current phase of the run."""
        if self.outcome is not None:
            return self.outcome
        return "training" if self.interactions else "starting"

    def handle(self, event: Event) -> list[Action]:
        """Process one event; returns the actions to execute in order."""
        self.clock.advance(event.now)
        if self.outcome is not None:
            self.clock.stop()
        if isinstance(event, Received):
            return self._receive(event)
        if isinstance(event, Interrupted):
            return self._finish("stopped", event.reason)
        if isinstance(event, KeysChanged):
            return self._leasing.end_revoked(event.allowed)
        if isinstance(event, LogRequest):
            return [self._log.add(event.text)]
        return self._leasing.report_lost()

    def _receive(self, event: Received) -> list[Action]:
        try:
            if self.outcome is not None:
                return self._receive_late(event, self.outcome)
            return self._dispatch(event, event.envelope.message)
        except ProtocolError as error:
            return [Send(event.peer, Failure(text=str(error)), answers=event.envelope.id)]

    def _dispatch(self, event: Received, message: Message) -> list[Action]:
        if isinstance(message, Sync):
            return self._sync(event, message)
        if isinstance(message, Claim):
            return self._leasing.claim(event, message)
        if isinstance(message, Release):
            return self._leasing.release(event.peer, message)
        if isinstance(message, EvaluationPoll):
            return [self._evaluator.poll(event.peer, message, event.envelope.id)]
        if isinstance(message, EvaluationReport):
            return self._evaluation_report(event.peer, message)
        if isinstance(message, Notice):
            return [self._log.add(line) for line in self._notice_filter.lines(message.text)]
        raise ProtocolError(f"the coordinator does not take {type(message).__name__} messages")

    def _receive_late(self, event: Received, outcome: Outcome) -> list[Action]:
        """Process a message after the end: learners' last work still counts."""
        message = event.envelope.message
        actions: list[Action] = []
        if isinstance(message, Sync) and self._leasing.renew(event.peer, message):
            actions = [*self._accept(message, event.envelope.arrays), self._reply(event, message)]
        elif isinstance(message, Release):
            actions = self._leasing.release(event.peer, message)
        return [*actions, Send(event.peer, Goodbye(reason=outcome), answers=event.envelope.id)]

    # Algorithm 1

    def _sync(self, event: Received, sync: Sync) -> list[Action]:
        """Apply a learner's progress and reply."""
        if not self._leasing.renew(event.peer, sync):
            return self._leasing.refuse_stale(event, sync)
        actions = self._accept(sync, event.envelope.arrays)
        actions += self._leasing.report_back(sync.pid)
        hints = self._stuck.due_lines(sync.pid, self.records, self.task, self.elapsed_s)
        actions += [self._log.add(line) for line in hints]
        actions.append(self._reply(event, sync))
        if self.interactions >= self.settings.max_interactions:
            actions += self._finish("budget spent", f"{self.interactions} interactions")
        return actions

    def _accept(self, sync: Sync, arrays: Mapping[str, NDArray[Any]]) -> list[Action]:
        """Apply a batch of progress once and store newer weights; returns log lines."""
        progress = unpack_progress(arrays, self.task.dfa.states, self.snapshot)
        record = self.records[sync.pid]
        actions: list[Action] = []
        if sync.sequence > record.sequence:
            record.sequence = sync.sequence
            self.method.told(sync.pid, progress.changes)
            starts = usable(progress.starts)
            self._hand_over(sync.pid, starts)
            dropped = len(progress.starts) - len(starts)
            actions += self._complain(
                sync.pid, f"{dropped} start states are dropped: they are not finite" * (dropped > 0)
            )
            record.update(finite_figures(sync.stats), self.clock.now)
        weights = without_prefix("weights.", arrays)
        return actions + self._complain(
            sync.pid, self._intake.take_weights(sync.pid, weights, sync.version, self.records)
        )

    def _hand_over(self, pid: str, starts: Sequence[Start]) -> None:
        """Add each state <s, q> to the initial-state buffers of sub-tasks that start there: for T4NMTD, E(Q, q)."""
        if starts:
            self.snapshot = starts[-1][1]
        going_on = [(q, state) for q, state in starts if q not in self.task.terminal]
        for q, state in going_on:
            for receiver in self.method.receivers(pid, q, self.rng):
                self.records[receiver].buffer.add(q, state)
        for receiver, q, state in self.method.advance(pid, going_on, self.rng):
            self.records[receiver].buffer.add(q, state)

    def _reply(self, event: Received, sync: Sync) -> Send:
        """The Q-table, the peers, and the start states new to the learner."""
        record = self.records[sync.pid]
        size = 1 if self.snapshot is None else self.snapshot.nbytes
        fresh = record.buffer.since(sync.start_cursor, most_starts(STARTS_PER_REPLY, size))
        reply = SyncReply(
            pid=sync.pid,
            epoch=sync.epoch,
            accepted_sequence=record.sequence,
            start_cursor=fresh[-1][0] if fresh else sync.start_cursor,
            q_table=self.method.entries(),
            peers=self._leasing.peers_of(sync.pid),
            evaluate=self._evaluator.stand_in_wanted(),
        )
        return Send(event.peer, reply, pack_starts([(q, state) for _, q, state in fresh]), event.envelope.id)

    def _complain(self, pid: str, trouble: str) -> list[Action]:
        """Log invalid data from a learner, once per lease."""
        record = self.records[pid]
        if not trouble or record.complained:
            return []
        record.complained = True
        return [self._log.add(f"{pid}: {trouble}")]

    # The end

    def _evaluation_report(self, peer: bytes, report: EvaluationReport) -> list[Action]:
        row = self._evaluator.report(peer, report, self.elapsed_s)
        if row is None:
            return []
        if not self.evaluations.solved:
            return [RecordEvaluation(row)]
        first, needed = self.evaluations.solved_at or 0, self.evaluations.config.in_a_row
        reason = solved_text(first, self.interactions, needed).removeprefix("solved ")
        return [RecordEvaluation(row), *self._finish("solved", reason)]

    def _finish(self, outcome: Outcome, reason: str) -> list[Action]:
        if self.outcome is not None:
            return []
        self.outcome = outcome
        self.clock.stop()
        leases = self.leases.holders(self.clock.now) + self.evaluator_lease.holders(self.clock.now)
        peers = sorted({lease.holder for lease in leases})
        logged = self._log.add(f"{outcome}: {reason}")
        return [logged, *(Send(peer, Goodbye(reason=outcome)) for peer in peers), Finish(outcome, reason)]

    # For tests

    def validate(self) -> None:
        """Check all invariants; tests call this after every event.

        Raises:
            InvariantError: if one is violated.
        """
        now, epochs = self.clock.now, self.leases.epochs() | self.evaluator_lease.epochs()
        check_leases(self.leases, now)
        check_leases(self.evaluator_lease, now)
        check_stand_ins(self.stand_ins, self.evaluator_lease)
        check_records(self.records, self.leases, self.task, now)
        check_q_table(self.method.entries(), self.task)
        check_evaluations(self.evaluations, self.records)
        check_events(self.events, EVENTS_KEPT)
        require(self.snapshot is None or self.snapshot.ndim == 1, "a start state has more than one dimension")
        require(self.outcome is not None or not self.evaluations.solved, "the task is solved and the run goes on")
        over = {"the outcome": float(self.outcome is not None), "elapsed_s": self.elapsed_s}
        self._growing.check({f"epoch of {place}": epoch for place, epoch in epochs.items()} | over)
