"""Which of two methods is better: probability of improvement, permutation test, Holm's correction, ratio of medians.

Runs are numbers by task of which the greater is the better. For interactions to solve, pass the negatives of
``censoring.times_or_never``: two unsolved runs tie.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import rankdata

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.statistics.bootstrap import CONFIDENCE, DRAWS, Estimate, percentile_estimate, resampled_counts
from t4nmtd_dist.statistics.inputs import Floats, RunsByTask, by_task, same_tasks, vector, whole

SIGNIFICANCE = 0.05
# Statistics that are equal but for rounding count as equal.
ROUNDING = 1e-9

Verdict: TypeAlias = Literal["better", "worse", "undecided"]


@dataclass(frozen=True)
class Comparison:
    """One method against another.

    Attributes:
        probability: that a run of the one is better than a run of the other, mean over tasks.
        p_value: of the permutation test, two-sided.
        adjusted: the same after Holm's correction for all comparisons made together.
        verdict: see :func:`verdict`.
    """

    probability: Estimate
    p_value: float
    adjusted: float
    verdict: Verdict


def probability_of_improvement(
    a: RunsByTask, b: RunsByTask, rng: np.random.Generator, *, draws: int = DRAWS, confidence: float = CONFIDENCE
) -> Estimate:
    """Probability that a run of ``a`` is greater than a run of ``b``; a tie counts half.

    That is the mean over tasks of U / (n m), U being the Mann-Whitney statistic of n and m runs, with a stratified
    bootstrap interval.

    Args:
        a: numbers by task, infinity allowed.
        b: the same tasks.
        rng: draws the runs of the bootstrap.
        draws: how many samples.
        confidence: above 0, below 1.

    Raises:
        ConfigError: if the tasks differ, one has no runs, or a number is nan.
    """
    ours, theirs = _pair(a, b)
    whole("draws", draws, 1)
    value, samples = 0.0, np.zeros(draws)
    for task, x in ours.items():
        y = theirs[task]
        wins = np.greater.outer(x, y) + 0.5 * np.equal.outer(x, y)
        value += wins.mean() / len(ours)
        counts, other_counts = (resampled_counts(len(runs), draws, rng) for runs in (x, y))
        samples += ((counts @ wins) * other_counts).sum(axis=1) / (wins.size * len(ours))
    return percentile_estimate(value, samples, (0, 1), confidence)


def permutation_p_value(a: RunsByTask, b: RunsByTask, rng: np.random.Generator, *, draws: int = DRAWS) -> float:
    """Two-sided p-value of the probability of improvement, if within each task runs of a and b are exchangeable.

    The observed order counts as one of the permutations, so that p is never 0 (``scipy.stats.permutation_test`` does
    the same, but for one task only).

    Args:
        a: numbers by task, infinity allowed.
        b: the same tasks.
        rng: draws the permutations.
        draws: how many permutations.

    Raises:
        ConfigError: if the tasks differ, one has no runs, or a number is nan.
    """
    ours, theirs = _pair(a, b)
    whole("draws", draws, 1)
    observed, permuted = 0.0, np.zeros(draws)
    for task, x in ours.items():
        y = theirs[task]
        ranks = rankdata(np.concatenate([x, y]))
        # U / (n m) is 0.5 if the mean rank of a is that of all
        per_rank = 1 / (len(x) * len(y) * len(ours))
        expected = len(x) * (len(ranks) + 1) / 2
        observed += (ranks[: len(x)].sum() - expected) * per_rank
        shuffled = rng.permuted(np.tile(ranks, (draws, 1)), axis=1)
        permuted += (shuffled[:, : len(x)].sum(axis=1) - expected) * per_rank
    extreme = int((np.abs(permuted) >= abs(observed) - ROUNDING).sum())
    return (1 + extreme) / (1 + draws)


def _pair(a: RunsByTask, b: RunsByTask) -> tuple[dict[str, Floats], dict[str, Floats]]:
    same_tasks(a, b)
    return by_task("a", a, inf=True), by_task("b", b, inf=True)


def holm(p_values: ArrayLike) -> Floats:
    """p-values adjusted for being several (Holm, 1979), in the order given, float64 [n].

    Raises:
        ConfigError: if there is none, or one is out of [0, 1].
    """
    p = vector("p_values", p_values, 0, 1)
    order = np.argsort(p, kind="stable")
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(1, np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)))
    return adjusted


def verdict(probability: Estimate, adjusted: float) -> Verdict:
    """Whether the one method is better than the other, is worse, or neither has been shown.

    "better" needs both: the interval lies above 0.5, and the adjusted p-value is below 0.05. "worse" mirrors it.
    """
    if adjusted >= SIGNIFICANCE:
        return "undecided"
    if probability.interval.low > 0.5:
        return "better"
    return "worse" if probability.interval.high < 0.5 else "undecided"


def compare(
    ours: RunsByTask, others: Mapping[str, RunsByTask], rng: np.random.Generator, *, draws: int = DRAWS
) -> dict[str, Comparison]:
    """One method against each of several, with Holm's correction over them all.

    Args:
        ours: numbers by task, infinity allowed.
        others: the same tasks, by name of the method.
        rng: draws the runs of the bootstrap and the permutations.
        draws: how many of each.

    Raises:
        ConfigError: if there is no other method, tasks differ, one has no runs, or a number is nan.
    """
    if not others:
        raise ConfigError("others: expected at least one method to compare with, got none")
    chances = {name: probability_of_improvement(ours, runs, rng, draws=draws) for name, runs in others.items()}
    p_values = {name: permutation_p_value(ours, runs, rng, draws=draws) for name, runs in others.items()}
    adjusted = dict(zip(others, holm(list(p_values.values())).tolist(), strict=True))
    return {
        name: Comparison(chance, p_values[name], adjusted[name], verdict(chance, adjusted[name]))
        for name, chance in chances.items()
    }
