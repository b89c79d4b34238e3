"""What is drawn over the interactions while a run goes on: curves of the evaluations and of every learner."""

from __future__ import annotations

from coordinator.learner_registry import LearnerRecord
from t4nmtd_dist.wire.messages import EvaluationRow


def evaluation_scalars(row: EvaluationRow) -> dict[str, float | None]:
    """Success from 0 to 1, steps and validation reward of an evaluation: means over its episodes."""
    return {"success_rate": row.success_rate, "mean_length": row.mean_length, "mean_return": row.mean_return}


def learner_scalars(record: LearnerRecord) -> dict[str, float | None]:
    """A learner's newest figures; None where there is none yet.

    Entropy is in nats, rates are over the last ten seconds. ``own_used_share`` (of the values asked from peers, those
    for which the learner's own critic had to serve) and ``mean_lag`` (versions by which answers were behind) are over
    the whole run.
    """
    total = record.total
    peers = total.intervention
    steps_per_s, updates_per_s = record.rates()
    return {
        "recent_success": total.recent_success,
        "entropy": total.entropy,
        "critic_loss": total.value_loss,
        "steps_per_s": steps_per_s,
        "updates_per_s": updates_per_s,
        "own_used_share": peers.own_used / peers.asked if peers.asked else None,
        "mean_lag": peers.lag_total / peers.answered if peers.answered else None,
    }
