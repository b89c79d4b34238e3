"""Validates workers' reports against the task."""

from __future__ import annotations

import math

import msgspec

from t4nmtd_dist.core.errors import ProtocolError
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.wire.messages import EvaluationReport, LearnerStats
from t4nmtd_dist.wire.statistics import by_name


def finite_figures(stats: LearnerStats) -> LearnerStats:
    """Replace non-finite gauges by None: a diverging learner may continue."""
    unusable: dict[str, None] = {
        name: None for name, value in by_name(stats).items() if isinstance(value, float) and not math.isfinite(value)
    }
    return msgspec.structs.replace(stats, **unusable) if unusable else stats


def check_report(report: EvaluationReport, task: CompiledTask) -> None:
    """Check an evaluation against the task.

    Raises:
        ProtocolError: if it has no episodes or too long ones, or its path leaves the automaton.
    """
    horizon = task.config.environment.horizon
    if not report.episodes:
        raise ProtocolError("evaluation report: expected at least one episode")
    if max(report.mean_length, report.std_length) > horizon:
        raise ProtocolError(
            f"evaluation report: episodes of {report.mean_length} steps; at most {horizon} are possible"
        )
    if any(q >= task.dfa.states for q in report.dfa_path):
        raise ProtocolError(f"evaluation report: the path leaves the DFA states 0..{task.dfa.states - 1}")
