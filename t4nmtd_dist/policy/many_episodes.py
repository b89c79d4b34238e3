"""Plays many episodes of a policy, some at a time, and sums them up."""

from __future__ import annotations

from typing import Any

import numpy as np

from t4nmtd_dist.core.action_modes import ActionMode
from t4nmtd_dist.policy.evaluation import EvaluationResult, Evaluator
from t4nmtd_dist.policy.global_policy import GlobalPolicy

EPISODES_AT_ONCE = 50


def play_many(
    policy: GlobalPolicy, episodes: int, *, seed: int, perturb: int = 0, actions: ActionMode | None = None
) -> dict[str, Any]:
    """Play ``episodes``; other arguments as for ``Evaluator``.

    Returns:
        ``success_rate``, ``mean_length``, ``mean_return``, ``episodes``, and ``redrawn``, the number of perturbed
        starts that were drawn again.
    """
    results: list[EvaluationResult] = []
    for first in range(0, episodes, EPISODES_AT_ONCE):
        evaluator = Evaluator(policy, min(EPISODES_AT_ONCE, episodes - first), seed=seed + first)
        results.append(evaluator.run(policy, perturb=perturb, actions=actions))
    success = np.concatenate([result.success for result in results])
    return {
        "success_rate": float(success.mean()),
        "mean_length": float(np.concatenate([result.lengths for result in results]).mean()),
        "mean_return": float(np.concatenate([result.returns for result in results]).mean()),
        "episodes": len(success),
        "redrawn": sum(result.redrawn for result in results),
    }
