"""Hands out evaluations to evaluators and records their reports."""

from __future__ import annotations

from collections.abc import Mapping

from coordinator.checks import check_report
from coordinator.evaluations import EvaluationSchedule, PolicySnapshot
from coordinator.event_log import RunClock
from coordinator.events import Send
from coordinator.learner_registry import LearnerRecord, interactions, processor_s
from coordinator.leasing import EVALUATOR, Leasing
from coordinator.refusals import stale_evaluator
from t4nmtd_dist.agents.weights import acting_parameters
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.method.protocol import Method
from t4nmtd_dist.wire.messages import EvaluationJob, EvaluationPoll, EvaluationReport, EvaluationRow


class EvaluatorDuty:
    """Hands out evaluations of the composed policy."""

    def __init__(
        self,
        task: CompiledTask,
        records: Mapping[str, LearnerRecord],
        method: Method,
        leasing: Leasing,
        clock: RunClock,
    ) -> None:
        self._task, self._records, self._method = task, records, method
        self._leasing, self._clock = leasing, clock
        self.schedule = EvaluationSchedule(task.config.evaluation)

    def poll(self, peer: bytes, poll: EvaluationPoll, answers: int) -> Send:
        """Renew an evaluator's lease and hand out an evaluation if one is due."""
        if not self._leasing.evaluator.renew(EVALUATOR, poll.epoch, peer, self._clock.now):
            return Send(peer, stale_evaluator(EVALUATOR), answers=answers)
        if poll.busy or not self.due():
            return Send(peer, EvaluationJob(job=0), answers=answers)
        return self._hand_out(peer, answers)

    def _hand_out(self, peer: bytes, answers: int) -> Send:
        versions = self._versions()
        weights = {pid: acting_parameters(self._records[pid].weights) for pid in versions}
        snapshot = self.schedule.hand_out(interactions(self._records), self._method.entries(), versions, weights)
        arrays = {f"{pid}/weights.{name}": array for pid, named in weights.items() for name, array in named.items()}
        return Send(peer, self._job(snapshot), arrays, answers)

    def _job(self, snapshot: PolicySnapshot) -> EvaluationJob:
        return EvaluationJob(
            job=snapshot.job,
            interactions=snapshot.interactions,
            q_table=snapshot.q_table,
            versions=snapshot.versions,
            actions=self.schedule.modes,
        )

    def report(self, peer: bytes, report: EvaluationReport, elapsed_s: float) -> EvaluationRow | None:
        """Record an evaluation; None if it is not the pending one.

        Raises:
            ProtocolError: if it is impossible for the task.
        """
        if not self._leasing.evaluator.renew(EVALUATOR, report.epoch, peer, self._clock.now):
            return None
        check_report(report, self._task)
        return self.schedule.report(report, elapsed_s)

    def due(self) -> bool:
        """Whether an evaluation is due now."""
        learners_s = processor_s(self._records)
        return self.schedule.due(interactions(self._records), self._versions(), self._training(), learners_s)

    def stand_in_wanted(self) -> bool:
        """Whether an evaluation is due without an evaluator."""
        started = interactions(self._records) > 0
        return started and self._leasing.stand_ins.wanted(self._clock.now) and self.due()

    def _versions(self) -> dict[str, int]:
        return {pid: record.version for pid, record in self._records.items() if record.version}

    def _training(self) -> frozenset[str]:
        """The sub-tasks whose newer weights an evaluation waits for."""
        return frozenset(
            pid
            for pid, record in self._records.items()
            if record.current.phase == "training"
            and not record.unusable
            and self._leasing.learners.live(pid, self._clock.now)
        )
