"""TensorBoard scalars of evaluations and learners, over interactions."""

from __future__ import annotations

from coordinator.learner_registry import LearnerRecord
from t4nmtd_dist.wire.messages import EvaluationRow
from t4nmtd_dist.wire.statistics import scalars


def evaluation_scalars(row: EvaluationRow) -> dict[str, float | None]:
    """An evaluation's success rate (0 to 1), mean length in steps, and mean return."""
    return {"success_rate": row.success_rate, "mean_length": row.mean_length, "mean_return": row.mean_return}


def learner_scalars(record: LearnerRecord) -> dict[str, float | None]:
    """A learner's newest values; None where there is none yet.

    Rates cover the last ten seconds; sums and ratios the whole run.
    """
    return scalars(record.total, record.rates())
