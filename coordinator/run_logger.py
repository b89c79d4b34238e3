"""Writes the state machine's actions into the run directory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from coordinator.best_policy import export_best
from coordinator.events import Action, Finish, LogEvent, RecordEvaluation
from coordinator.scalars import evaluation_scalars, learner_scalars
from coordinator.snapshot import summary
from coordinator.state import CoordinatorState
from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.runs.directory import RunDirectory
from t4nmtd_dist.runs.event_files import TensorBoard, open_event_files
from t4nmtd_dist.wire.messages import EvaluationRow
from t4nmtd_dist.wire.rate_limited_log import Log, RateLimitedLog
from t4nmtd_dist.wire.statistics import by_name

METRICS_EVERY_S = 5.0


class RunLogger:
    """Writes a run's events, metrics, summary and policy.

    Args:
        tell: logs failed writes; a full disk does not end training.

    Raises:
        ConfigError: if requested event files cannot be written.
    """

    def __init__(
        self, state: CoordinatorState, run: RunDirectory, tensorboard: TensorBoard = "off", tell: Log = print
    ) -> None:
        self._state, self._run = state, run
        self._notices = RateLimitedLog(tell)
        self._result_due = False
        self._event_files = open_event_files(run.path / "tensorboard", tensorboard, state.interactions)
        self._metrics_due = 0.0
        settings = state.settings
        run.write_settings(state.task.config, settings.seed, settings.max_interactions)

    def record(self, action: Action) -> None:
        """Write an action, if it is one to record."""
        with self._telling():
            if isinstance(action, LogEvent):
                self._run.log_event(action.elapsed_s, action.text)
            elif isinstance(action, RecordEvaluation):
                self._evaluation(action.row)
            elif isinstance(action, Finish):
                self._result_due = True
                self._finish()

    @contextmanager
    def _telling(self) -> Iterator[None]:
        """Report a failed write and continue."""
        try:
            yield
        except OSError as error:
            self._notices.log(f"cannot write to {self._run.path}: {error.strerror or error}; going on without")

    def _evaluation(self, row: EvaluationRow) -> None:
        self._run.append_metrics(
            "evaluations",
            {
                "elapsed_s": round(row.elapsed_s, 3),
                "interactions": row.interactions,
                "success_rate": row.success_rate,
                "mean_length": row.mean_length,
                "std_length": row.std_length,
                "mean_return": row.mean_return,
                "actions": row.actions,
                "other_success_rate": row.other_success_rate,
            },
        )
        if self._event_files is not None:
            self._event_files.add("evaluations", row.interactions, evaluation_scalars(row))
        best = self._state.evaluations.best
        if best is not None and best.row is row:
            export_best(self._state, self._run.path / "policy")

    def metrics(self) -> None:
        """Append every learner's counts every few seconds."""
        state = self._state
        if state.elapsed_s < self._metrics_due:
            return
        self._metrics_due = state.elapsed_s + METRICS_EVERY_S
        with self._telling():
            self._learners()

    def _learners(self) -> None:
        state = self._state
        for pid, record in state.records.items():
            about_run = {"elapsed_s": round(state.elapsed_s, 3), "interactions_of_all": state.interactions}
            statistics = by_name(record.total) | {"start_states": len(record.buffer)}
            self._run.append_metrics(pid, about_run | statistics)
            if self._event_files is not None:
                self._event_files.add(pid, state.interactions, learner_scalars(record))

    def _finish(self) -> None:
        state = self._state
        self._metrics_due = 0.0
        self.metrics()
        export_best(state, self._run.path / "policy")
        self._run.write_summary(summary(state))
        self._result_due = False

    @property
    def solved(self) -> bool:
        """Whether the run is over because its task is solved."""
        return self._state.outcome == "solved"

    def close(self) -> None:
        """Write the final counts, including those learners reported after the end.

        Raises:
            RunError: if the policy or the summary cannot be written.
        """
        self._metrics_due = 0.0
        self.metrics()
        try:
            if self._result_due:
                self._finish()
            self._run.write_summary(summary(self._state))
        except OSError as error:
            path = self._run.path
            raise RunError(
                f"cannot write the result of the run to {path}: {error.strerror or error}; make room, then go on from "
                f"its last checkpoint by --resume {path}"
            ) from None
