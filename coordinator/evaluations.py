"""When to evaluate the global policy, and when the task counts as solved or converged."""

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
    """The composed policy as it was when an evaluation was handed out: weights by pid, and Q.

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
    """A policy and what its evaluation came to."""

    snapshot: PolicySnapshot
    row: EvaluationRow

    def state_dict(self) -> State:
        """Everything, for a checkpoint; the weights are the very arrays that are held."""
        snapshot = {each.name: getattr(self.snapshot, each.name) for each in fields(self.snapshot)}
        return {"snapshot": snapshot, "row": msgspec.to_builtins(self.row)}

    @staticmethod
    def of(state: State) -> EvaluatedPolicy:
        """What a ``state`` is of."""
        snapshot = dict(state["snapshot"])
        snapshot["q_table"] = [(q, pid, value) for q, pid, value in snapshot["q_table"]]
        return EvaluatedPolicy(PolicySnapshot(**snapshot), msgspec.convert(state["row"], EvaluationRow))


@dataclass
class EvaluationSchedule:
    """Hands out evaluations on fresh weights, counts how many in a row succeeded, and keeps the best policy.

    Attributes:
        best: the policy of the highest success rate so far, the newest among equals.
        processor_s: processor time of all evaluations.
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
        """Everything but an evaluation that is under way, which nobody will report after a resume."""
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
        """Go on from a ``state``."""
        self.history = msgspec.convert(state["history"], list[EvaluationRow])
        self.pending, best = None, state.get("best")
        if state.get("last") is not None and state["history"]:  # as older checkpoints have it
            best = {"snapshot": state["last"], "row": state["history"][-1]}
        self.best = None if best is None else EvaluatedPolicy.of(best)
        self.processor_s = state["processor_s"]
        self._jobs, self._handed_at, self._row_from = state["jobs"], state["handed_at"], state["row_from"]
        self._handed_versions = state["handed_versions"]

    def begin_row(self) -> None:
        """Count no evaluation so far towards those in a row: of some that followed nothing is known."""
        self._row_from = len(self.history)

    def due(self, interactions: int, versions: Mapping[str, int], training: frozenset[str], learners_s: float) -> bool:
        """Whether enough was learned since the last evaluation for one on fresh weights, and it can be afforded.

        Evaluations take no more than a tenth of the processor time of all; the first is free.

        Args:
            interactions: environment steps so far.
            versions: newest weights by pid.
            training: sub-tasks whose learner is alive and training; each must have newer weights.
            learners_s: processor time of the learners.
        """
        if self.share(learners_s) > PROCESSOR_SHARE:
            return False
        if not versions or interactions < self._handed_at + self.config.every:
            return False
        newer = [version > self._handed_versions.get(pid, 0) for pid, version in versions.items() if pid in training]
        return any(newer) and all(newer)

    def share(self, learners_s: float) -> float:
        """Of the processor time of learners and evaluations, what evaluations took; 0 if nothing is known."""
        return self.processor_s / max(self.processor_s + learners_s, 1e-9)

    def hand_out(
        self,
        interactions: int,
        q_table: QEntries,
        versions: Mapping[str, int],
        weights: Mapping[str, Mapping[str, NDArray[Any]]],
    ) -> PolicySnapshot:
        """The next evaluation's policy."""
        self._jobs += 1
        self._handed_at = interactions
        self._handed_versions = dict(versions)
        self.pending = PolicySnapshot(self._jobs, interactions, q_table, dict(versions), dict(weights))
        return self.pending

    def report(self, report: EvaluationReport, elapsed_s: float) -> EvaluationRow | None:
        """Record a result; None if it is not the one waited for."""
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
        """Keep a policy as the best if none before it succeeded more often."""
        if self.best is None or rank(evaluated.row) >= rank(self.best.row):
            self.best = evaluated

    @property
    def modes(self) -> tuple[ActionMode, ...]:
        """How the next evaluation is played; see ``modes_to_play``."""
        return modes_to_play(self.config.actions, self.history[-1].actions if self.in_a_row else None)

    @property
    def in_a_row(self) -> int:
        """The newest evaluations that reached the wanted success rate, all in the mode of the last one."""
        count = 0
        for row in reversed(self.history[self._row_from :]):
            if row.actions != self.history[-1].actions or not row.success_rate >= self.config.success:
                break  # a rate that is not a number is none
            count += 1
        return count

    @property
    def solved(self) -> bool:
        """Whether enough evaluations in a row succeeded."""
        return self.in_a_row >= self.config.in_a_row

    @property
    def converged(self) -> bool:
        """Solved, and the mean episode length of those evaluations spreads by less than 10 %."""
        lengths = [row.mean_length for row in self.history[-self.config.in_a_row :]]
        return self.solved and float(np.std(lengths)) < CONVERGED_LENGTH_SPREAD * float(np.mean(lengths))

    @property
    def solved_at(self) -> int | None:
        """Interactions at the first of the evaluations that solved the task; None while unsolved."""
        return self.history[-self.config.in_a_row].interactions if self.solved else None


def rank(row: EvaluationRow) -> float:
    """The success rate; one that is not a number is below all others."""
    return -1.0 if np.isnan(row.success_rate) else row.success_rate
