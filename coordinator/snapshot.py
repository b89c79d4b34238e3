"""The coordinator's state for dashboards, and the run's summary."""

from __future__ import annotations

import math
from functools import reduce
from typing import Any

from coordinator.learner_registry import LearnerRecord
from coordinator.state import CoordinatorState
from coordinator.stuck import stuck_lines
from coordinator.worker_commands import WorkerCommands
from t4nmtd_dist.core.version import __version__
from t4nmtd_dist.wire.messages import (
    DashboardState,
    EvaluationRow,
    Intervention,
    LearnerPhase,
    LearnerRow,
    Missing,
    QCell,
    Status,
)
from t4nmtd_dist.wire.statistics import added

EVALUATIONS_SHOWN = 200


def dashboard_state(state: CoordinatorState, commands: WorkerCommands | None = None) -> DashboardState:
    """Everything a dashboard draws; ``commands`` start missing workers, None if a launcher does."""
    task = state.task
    return DashboardState(
        task=task.config.name,
        title=task.config.title,
        formula=" ".join(task.config.formula.split()),
        run_dir=state.settings.run_dir,
        seed=state.settings.seed,
        phase=state.phase,
        elapsed_s=state.elapsed_s,
        interactions=state.interactions,
        max_interactions=state.settings.max_interactions,
        dfa_states=task.dfa.states,
        accepting=sorted(task.dfa.accepting),
        error=sorted(task.dfa.error),
        dist=[_finite(task.dist.get(q, math.inf)) for q in range(task.dfa.states)],
        solved_in_a_row=state.evaluations.in_a_row,
        solved_needed=task.config.evaluation.in_a_row,
        learners=[_learner_row(state, pid, record) for pid, record in state.records.items()],
        q_table=_q_cells(state),
        evaluations=thinned(state.evaluations.history, EVALUATIONS_SHOWN),
        events=list(state.events),
        acceptance="end" if task.config.acceptance == "end" else "first",
        success_needed=state.task.config.evaluation.success,
        solved_at=state.evaluations.solved_at,
        policy=_kept(state),
        missing=missing(state, commands),
    )


def status(state: CoordinatorState, clock: float, commands: WorkerCommands | None = None) -> Status:
    """The reply to ``t4nmtd status``; ``clock`` is Unix time in seconds, ``commands`` as for ``dashboard_state``."""
    history = state.evaluations.history
    evaluator = state.stand_ins.evaluator(state.clock.now)
    return Status(
        program=__version__,
        clock=clock,
        task=state.task.config.name,
        seed=state.settings.seed,
        run_dir=state.settings.run_dir,
        phase=state.phase,
        elapsed_s=state.elapsed_s,
        interactions=state.interactions,
        max_interactions=state.settings.max_interactions,
        success_rate=history[-1].success_rate if history else None,
        solved_in_a_row=state.evaluations.in_a_row,
        solved_needed=state.task.config.evaluation.in_a_row,
        evaluator=evaluator.instance if evaluator else "",
        learners=[_learner_row(state, pid, record) for pid, record in state.records.items()],
        critics={lease.place: lease.endpoint for lease in state.leases.holders(state.clock.now)},
        success_needed=state.task.config.evaluation.success,
        solved_at=state.evaluations.solved_at,
        policy=_kept(state),
        missing=missing(state, commands),
    )


def _kept(state: CoordinatorState) -> EvaluationRow | None:
    best = state.evaluations.best
    return None if best is None else best.row


def missing(state: CoordinatorState, commands: WorkerCommands | None) -> list[Missing]:
    """Missing workers with the commands that start them."""
    if commands is None or state.outcome is not None:
        return []
    alone = [pid for pid in state.records if not state.leases.live(pid, state.clock.now)]
    found = [Missing(what=pid, command=commands.learner(pid)) for pid in alone]
    if state.stand_ins.evaluator(state.clock.now) is None:
        found.append(Missing(what="evaluator", command=commands.evaluator(), needed=False))
    return found


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None


def _learner_row(state: CoordinatorState, pid: str, record: LearnerRecord) -> LearnerRow:
    lease, total = state.leases.get(pid), record.total
    return LearnerRow(
        pid=pid,
        phase=_phase(state, pid, total.phase),
        worker=lease.instance if lease else "",
        epoch=lease.epoch if lease else 0,
        version=record.version,
        starts_waiting=len(record.buffer),
        heartbeat_age_s=state.clock.now - lease.heard if lease else None,
        total=total,
        rates=record.rates() if state.outcome is None else {},
        hint="\n".join(stuck_lines(pid, state.records, state.task)) if state.outcome is None else "",
    )


def _phase(state: CoordinatorState, pid: str, reported: LearnerPhase) -> LearnerPhase:
    lease = state.leases.get(pid)
    if lease is None or lease.released:
        return "free"
    return reported if state.leases.live(pid, state.clock.now) or state.outcome is not None else "lost"


def _q_cells(state: CoordinatorState) -> list[QCell]:
    greedy = state.method.choose(range(state.task.dfa.states))
    return [QCell(q=q, pid=pid, value=value, greedy=greedy[q] == pid) for q, pid, value in state.method.entries()]


def thinned(history: list[EvaluationRow], most: int) -> list[EvaluationRow]:
    """At most ``most`` evenly spaced rows, always including the newest."""
    stride = max(1, math.ceil(len(history) / most))
    return history[::-1][::stride][::-1]


def summary(state: CoordinatorState) -> dict[str, Any]:
    """The content of ``summary.json``, final once the run is over."""
    evaluations = state.evaluations
    last = evaluations.history[-1] if evaluations.history else None
    counts = reduce(added, (record.total.intervention for record in state.records.values()), Intervention())
    solved = state.outcome == "solved"
    return {
        "task": state.task.config.name,
        "seed": state.settings.seed,
        "outcome": state.outcome,
        "solved": solved,
        "converged": evaluations.converged,
        "interactions": evaluations.solved_at if solved else state.interactions,
        "interactions_total": state.interactions,
        "success_rate": last.success_rate if last else 0.0,
        "episode_length": last.mean_length if last else None,
        "transfer_from": state.settings.transfer_from or None,
        "in_a_row": evaluations.config.in_a_row,
        "policy": _policy_summary(_kept(state)),
        "evaluations": len(evaluations.history),
        "evaluations_processor_share": round(evaluations.share(state.learners_s), 4),
        "wall_s": round(state.elapsed_s, 3),
        "gradient_steps": sum(record.total.gradient_steps for record in state.records.values()),
        "intervention": {
            "asked": counts.asked,
            "answered": counts.answered,
            "late": counts.late,
            "own_used": counts.own_used,
            "lag_mean": counts.lag_total / counts.answered if counts.answered else None,
        },
        "learners": {
            pid: {
                "interactions": record.total.interactions,
                "attempts": record.total.attempts,
                "successes": record.total.successes,
                "gradient_steps": record.total.gradient_steps,
            }
            for pid, record in state.records.items()
        },
    }


def _policy_summary(row: EvaluationRow | None) -> dict[str, Any] | None:
    """The summary of the best policy."""
    if row is None:
        return None
    return {
        "interactions": row.interactions,
        "success_rate": row.success_rate,
        "actions": row.actions,
        "job": row.job,
    }
