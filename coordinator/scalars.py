"""What is drawn over the interactions while a run goes on: curves of the evaluations and of every learner."""

from __future__ import annotations

from coordinator.learner_registry import LearnerRecord
from t4nmtd_dist.wire.messages import EvaluationRow
from t4nmtd_dist.wire.statistics import scalars


def evaluation_scalars(row: EvaluationRow) -> dict[str, float | None]:
    """Success from 0 to 1, steps and validation reward of an evaluation: means over its episodes."""
    return {"success_rate": row.success_rate, "mean_length": row.mean_length, "mean_return": row.mean_return}


def learner_scalars(record: LearnerRecord) -> dict[str, float | None]:
    """A learner's newest figures; None where there is none yet.

    Rates are over the last ten seconds; sums and ratios are over the whole run.
    """
    return scalars(record.total, record.rates())
