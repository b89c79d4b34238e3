"""Scores in [0, 1] and their sums over runs and tasks (Agarwal et al., NeurIPS 2021).

Intervals are those of the stratified bootstrap: runs are drawn again within each task.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import trim_mean

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.statistics.bootstrap import (
    CONFIDENCE,
    DRAWS,
    Band,
    Estimate,
    percentile_estimate,
    percentiles,
    resampled_counts,
    resampled_runs,
)
from t4nmtd_dist.statistics.inputs import (
    Bools,
    Floats,
    RunsByTask,
    by_task,
    number,
    same_length,
    solving_times,
    vector,
    whole,
)

TRIMMED = 0.25


def area_under_success(interactions: ArrayLike, success: ArrayLike, cap: float) -> float:
    """Area under the success curve of one run on [0, cap], divided by cap: 1 would be solved from the start.

    Success is 0 before the first evaluation; an evaluation holds until the next one, the last until the cap: a solved
    run stops early and keeps what it reached.

    Args:
        interactions: at which the run was evaluated, rising [n].
        success: share of successful episodes, from 0 to 1 [n].
        cap: the most interactions that a run was given.

    Raises:
        ConfigError: if there is no evaluation, one is out of range, or interactions do not rise.
    """
    x = vector("interactions", interactions, 0, number("cap", cap, 0, np.inf))
    y = vector("success", success, 0, 1)
    same_length(interactions=x, success=y)
    held = np.diff(x, append=cap)
    if (held[:-1] <= 0).any():
        first = int((held[:-1] <= 0).argmax())
        raise ConfigError(f"interactions: expected rising numbers, got {x[first]:g} and then {x[first + 1]:g}")
    return min(1.0, float(y @ held) / cap)


def interquartile_mean(
    scores: RunsByTask, rng: np.random.Generator, *, draws: int = DRAWS, confidence: float = CONFIDENCE
) -> Estimate:
    """Mean of the middle half of all runs of all tasks; of fewer than four runs, nothing is trimmed.

    Args:
        scores: from 0 to 1, by task.
        rng: draws the runs of the bootstrap.
        draws: how many samples.
        confidence: above 0, below 1.

    Raises:
        ConfigError: if a task has no runs or a score is out of range.
    """

    def middle(runs: Floats) -> Floats:
        return np.asarray(trim_mean(runs, TRIMMED, axis=1))

    return _over_tasks(scores, middle, (0, 1), rng, draws, confidence)


def optimality_gap(
    scores: RunsByTask,
    rng: np.random.Generator,
    *,
    target: float = 1.0,
    draws: int = DRAWS,
    confidence: float = CONFIDENCE,
) -> Estimate:
    """Mean amount by which runs miss the target score; what exceeds the target does not make up for it.

    Args:
        scores: from 0 to 1, by task.
        rng: draws the runs of the bootstrap.
        target: from 0 to 1.
        draws: how many samples.
        confidence: above 0, below 1.

    Raises:
        ConfigError: if a task has no runs, or a score or the target is out of range.
    """
    [goal] = vector("target", [target], 0, 1)

    def gap(runs: Floats) -> Floats:
        return np.asarray(np.maximum(goal - runs, 0).mean(axis=1))

    return _over_tasks(scores, gap, (0, float(goal)), rng, draws, confidence)


def _over_tasks(
    scores: RunsByTask,
    statistic: Callable[[Floats], Floats],
    limits: tuple[float, float],
    rng: np.random.Generator,
    draws: int,
    confidence: float,
) -> Estimate:
    """``statistic``: from [draws, all runs] to [draws]."""
    runs = by_task("scores", scores, 0, 1)
    value = float(statistic(np.concatenate(list(runs.values()))[np.newaxis])[0])
    samples = statistic(resampled_runs(runs, whole("draws", draws, 1), rng))
    return percentile_estimate(value, samples, limits, confidence)


def performance_profile(
    scores: RunsByTask,
    taus: ArrayLike,
    rng: np.random.Generator,
    *,
    draws: int = DRAWS,
    confidence: float = CONFIDENCE,
) -> Band:
    """Share of all runs of all tasks with a score above tau, for every tau.

    Args:
        scores: from 0 to 1, by task.
        taus: from 0 to 1 [n].
        rng: draws the runs of the bootstrap.
        draws: how many samples.
        confidence: above 0, below 1.

    Raises:
        ConfigError: if a task has no runs, or a score or tau is out of range.
    """
    grid = vector("taus", taus, 0, 1)
    above = {task: runs[:, np.newaxis] > grid for task, runs in by_task("scores", scores, 0, 1).items()}
    return _share(grid, above, rng, draws, confidence)


def share_solved(
    times: RunsByTask,
    caps: Mapping[str, float],
    fractions: ArrayLike,
    rng: np.random.Generator,
    *,
    draws: int = DRAWS,
    confidence: float = CONFIDENCE,
) -> Band:
    """Share of all runs of all tasks solved within a fraction of their task's cap, for every fraction.

    Args:
        times: interactions to solve by task, infinity if not solved within the cap, see ``censoring.times_or_never``.
        caps: the most interactions that a run was given, by task.
        fractions: from 0 to 1 [n].
        rng: draws the runs of the bootstrap.
        draws: how many samples.
        confidence: above 0, below 1.

    Raises:
        ConfigError: if a task has no runs or no cap, a finite time is above its cap, or a fraction is out of range.
    """
    grid = vector("fractions", fractions, 0, 1)
    runs = solving_times("times", times, caps)
    within = {task: each[:, np.newaxis] <= grid * caps[task] for task, each in runs.items()}
    return _share(grid, within, rng, draws, confidence)


def _share(x: Floats, counted: Mapping[str, Bools], rng: np.random.Generator, draws: int, confidence: float) -> Band:
    """``counted``: by task, whether a run counts at a point [runs, points]."""
    counts, samples = np.zeros(len(x)), np.zeros((whole("draws", draws, 1), len(x)))
    for runs in counted.values():
        counts += runs.sum(axis=0)
        samples += resampled_counts(len(runs), draws, rng) @ runs
    total = sum(len(runs) for runs in counted.values())  # divided by last, so that all runs are exactly 1
    low, high = percentiles(samples, confidence)
    return Band(x, counts / total, np.minimum(low, counts) / total, np.maximum(high, counts) / total)
