"""One evaluation in one mode or both: which are played, and which counts."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass

from t4nmtd_dist.core.action_modes import ActionMode
from t4nmtd_dist.policy.evaluation import EvaluationResult, Evaluator
from t4nmtd_dist.policy.global_policy import GlobalPolicy


@dataclass(frozen=True)
class Played:
    """The episodes that an evaluation reports.

    Attributes:
        mode: how they were played.
        result: what they came to.
        other_success_rate: success rate in the other mode; None where only one was played.
    """

    mode: ActionMode
    result: EvaluationResult
    other_success_rate: float | None


def play(
    evaluator: Evaluator, policy: GlobalPolicy, modes: Sequence[ActionMode], enough: float
) -> Generator[None, None, Played]:
    """Play the first mode, and each further one only where those before it fall short; the best counts.

    It goes step by step, for a caller that has other things to do in between, and returns what was played.

    Args:
        evaluator: plays the episodes.
        policy: what acts.
        modes: in the order in which to try them, at least one.
        enough: success rate that makes further modes needless.
    """
    results: dict[ActionMode, EvaluationResult] = {}
    for mode in modes:
        results[mode] = yield from evaluator.steps(policy, actions=mode)
        if results[mode].success_rate >= enough:
            break
    best = max(results, key=lambda mode: (results[mode].success_rate, mode == "greedy"))
    others = [result.success_rate for mode, result in results.items() if mode != best]
    return Played(best, results[best], max(others, default=None))
