"""When to evaluate the global policy, and when the task is solved or converged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.action_modes import ActionMode, modes_to_play
from t4nmtd_dist.core.config import EvaluationConfig
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.method.high_level import QEntries
from t4nmtd_dist.wire.messages import EvaluationReport, EvaluationRow

CONVERGED_LENGTH_SPREAD = 0.1
PROCESSOR_SHARE = 0.1


@dataclass(frozen=True)
class PolicySnapshot:
    """The composed policy when an evaluation was handed out: weights by pid, and Q.

    Attributes:
        interactions: environment steps of all learners up to then.
    """

    job: int
    interactions: int
    q_table: QEntries
    versions: dict[str, int]
    weights: Mapping[str, Mapping[str, NDArray[Any]]]


@dataclass(frozen=True)
class EvaluatedPolicy:
    """A policy and its evaluation."""

    snapshot: PolicySnapshot
    row: EvaluationRow

    def state_dict(self) -> State:
        """The state for a checkpoint; weights are not copied."""
        snapshot = {each.name: getattr(self.snapshot, each.name) for each in fields(self.snapshot)}
        return {"snapshot": snapshot, "row": msgspec.to_builtins(self.row)}

    @staticmethod
    def of(state: State) -> EvaluatedPolicy:
        """Restore from ``state_dict``."""
        snapshot = dict(state["snapshot"])
        snapshot["q_table"] = [(q, pid, value) for q, pid, value in snapshot["q_table"]]
        return EvaluatedPolicy(PolicySnapshot(**snapshot), msgspec.convert(state["row"], EvaluationRow))


@dataclass
class EvaluationSchedule:
    """Hands out evaluations on fresh weights, counts consecutive successes, and keeps the best policy.

    Attributes:
        best: the policy with the highest success rate so far, the newest among equals.
        processor_s: CPU time of all evaluations in seconds.
    """

    config: EvaluationConfig
    history: list[EvaluationRow] = field(default_factory=list)
    pending: PolicySnapshot | None = None
    best: EvaluatedPolicy | None = None
    processor_s: float = 0.0
    _jobs: int = 0
    _handed_at: int = 0
    _handed_versions: dict[str, int] = field(default_factory=dict)
    _row_from: int = 0

    def state_dict(self) -> State:
        """Everything but the pending evaluation, which nobody reports after a resume."""
        return {
            "history": msgspec.to_builtins(self.history),
            "best": None if self.best is None else self.best.state_dict(),
            "processor_s": self.processor_s,
            "jobs": self._jobs,
            "handed_at": self._handed_at,
            "handed_versions": self._handed_versions,
            "row_from": self._row_from,
        }

    def load_state_dict(self, state: State) -> None:
        """Restore from ``state_dict``."""
        self.history = msgspec.convert(state["history"], list[EvaluationRow])
        self.pending, best = None, state.get("best")
        if state.get("last") is not None and state["history"]:  # format of older checkpoints
            best = {"snapshot": state["last"], "row": state["history"][-1]}
        self.best = None if best is None else EvaluatedPolicy.of(best)
        self.processor_s = state["processor_s"]
        self._jobs, self._handed_at, self._row_from = state["jobs"], state["handed_at"], state["row_from"]
        self._handed_versions = state["handed_versions"]

    def begin_row(self) -> None:
        """Restart the count of consecutive successes: later evaluations were lost."""
        self._row_from = len(self.history)

    def due(self, interactions: int, versions: Mapping[str, int], training: frozenset[str], learners_s: float) -> bool:
        """Whether enough was learned since the last evaluation, and another is affordable.

        Evaluations may use a tenth of the total CPU time; the first is free.

        Args:
            interactions: environment steps so far.
            versions: newest weights by pid.
            training: sub-tasks with a live, training learner; each must have newer weights.
            learners_s: CPU time of the learners in seconds.
        """
        if self.share(learners_s) > PROCESSOR_SHARE:
            return False
        if not versions or interactions < self._handed_at + self.config.every:
            return False
        newer = [version > self._handed_versions.get(pid, 0) for pid, version in versions.items() if pid in training]
        return any(newer) and all(newer)

    def share(self, learners_s: float) -> float:
        """Evaluations' share of all CPU time; 0 without evaluations."""
        return self.processor_s / max(self.processor_s + learners_s, 1e-9)

    def hand_out(
        self,
        interactions: int,
        q_table: QEntries,
        versions: Mapping[str, int],
        weights: Mapping[str, Mapping[str, NDArray[Any]]],
    ) -> PolicySnapshot:
        """Begin the next evaluation; returns its policy."""
        self._jobs += 1
        self._handed_at = interactions
        self._handed_versions = dict(versions)
        self.pending = PolicySnapshot(self._jobs, interactions, q_table, dict(versions), dict(weights))
        return self.pending

    def report(self, report: EvaluationReport, elapsed_s: float) -> EvaluationRow | None:
        """Record a result; None if it is not the pending one."""
        if self.pending is None or report.job != self.pending.job:
            return None
        snapshot, self.pending = self.pending, None
        self.processor_s += report.processor_s
        row = EvaluationRow(
            job=report.job,
            interactions=snapshot.interactions,
            elapsed_s=elapsed_s,
            success_rate=report.success_rate,
            mean_length=report.mean_length,
            std_length=report.std_length,
            mean_return=report.mean_return,
            dfa_path=report.dfa_path,
            actions=report.actions,
            other_success_rate=report.other_success_rate,
        )
        self.history.append(row)
        self.consider(EvaluatedPolicy(snapshot, row))
        return row

    def consider(self, evaluated: EvaluatedPolicy) -> None:
        """Keep a policy as the best unless an earlier one succeeded more often."""
        if self.best is None or rank(evaluated.row) >= rank(self.best.row):
            self.best = evaluated

    @property
    def modes(self) -> tuple[ActionMode, ...]:
        """Action modes of the next evaluation; see ``modes_to_play``."""
        return modes_to_play(self.config.actions, self.history[-1].actions if self.in_a_row else None)

    @property
    def in_a_row(self) -> int:
        """Number of newest evaluations that reached the target success rate in the same mode."""
        count = 0
        for row in reversed(self.history[self._row_from :]):
            if row.actions != self.history[-1].actions or not row.success_rate >= self.config.success:
                break  # NaN is no success
            count += 1
        return count

    @property
    def solved(self) -> bool:
        """Whether enough consecutive evaluations succeeded, and converged if the settings ask for it."""
        return self.converged if self.config.until == "converged" else self._succeeded

    @property
    def _succeeded(self) -> bool:
        return self.in_a_row >= self.config.in_a_row

    @property
    def converged(self) -> bool:
        """Enough consecutive successes, with a relative standard deviation of their mean episode lengths below 10 %."""
        lengths = [row.mean_length for row in self.history[-self.config.in_a_row :]]
        return self._succeeded and float(np.std(lengths)) < CONVERGED_LENGTH_SPREAD * float(np.mean(lengths))

    @property
    def solved_at(self) -> int | None:
        """Interactions at the first of the solving evaluations; None while unsolved."""
        return self.history[-self.config.in_a_row].interactions if self.solved else None


def rank(row: EvaluationRow) -> float:
    """The success rate; NaN ranks below all others."""
    return -1.0 if np.isnan(row.success_rate) else row.success_rate
