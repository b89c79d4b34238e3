"""Plays an evaluation in one or both action modes and selects the result."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass

from t4nmtd_dist.core.action_modes import ActionMode
from t4nmtd_dist.policy.evaluation import EvaluationResult, Evaluator
from t4nmtd_dist.policy.global_policy import GlobalPolicy


@dataclass(frozen=True)
class Played:
    """The reported episodes of an evaluation.

    Attributes:
        mode: their action mode.
        result: their result.
        other_success_rate: success rate in the other mode; None if it was not played.
    """

    mode: ActionMode
    result: EvaluationResult
    other_success_rate: float | None


def play(
    evaluator: Evaluator, policy: GlobalPolicy, modes: Sequence[ActionMode], enough: float
) -> Generator[None, None, Played]:
    """Play the first mode, and each further one while the success rate is below ``enough``; the best counts.

    Yields once per step, for interleaving with other work, and returns the result.
    """
    results: dict[ActionMode, EvaluationResult] = {}
    for mode in modes:
        results[mode] = yield from evaluator.steps(policy, actions=mode)
        if results[mode].success_rate >= enough:
            break
    best = max(results, key=lambda mode: (results[mode].success_rate, mode == "greedy"))
    others = [result.success_rate for mode, result in results.items() if mode != best]
    return Played(best, results[best], max(others, default=None))
