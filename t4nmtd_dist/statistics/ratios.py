"""How many times longer one of two settings takes than the other, over tasks, with runs paired by their seed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.statistics.bootstrap import CONFIDENCE, DRAWS, Interval, percentiles
from t4nmtd_dist.statistics.inputs import Floats, RunsByTask, same_tasks, solving_times, whole


@dataclass(frozen=True)
class Bounds:
    """What is known of a number: equal ends if it was measured, apart if an unsolved run leaves it open."""

    at_least: float
    at_most: float


@dataclass(frozen=True)
class RatioOfMedians:
    """Geometric mean over tasks of median(a) / median(b).

    Attributes:
        ratio: the geometric mean.
        interval: paired bootstrap interval; reaches 0 or infinity where too few runs are solved to bound it.
        by_task: median(a) / median(b) of every task.
    """

    ratio: Bounds
    interval: Interval
    by_task: Mapping[str, Bounds]


def ratio_of_medians(
    a: RunsByTask,
    b: RunsByTask,
    caps: Mapping[str, float],
    rng: np.random.Generator,
    *,
    draws: int = DRAWS,
    confidence: float = CONFIDENCE,
) -> RatioOfMedians:
    """Geometric mean over tasks of median(a) / median(b), with a paired bootstrap interval of its logarithm.

    Pairs are drawn again within each task. An unsolved run is known to take longer than its cap: a median that rests
    on one bounds the ratio from one side only. An interval runs from the lower percentile of the lower bounds to the
    upper percentile of the upper bounds.

    Args:
        a: interactions to solve by task, above 0, infinity if not solved within the cap; the same seeds in one order.
        b: the same of the other setting.
        caps: the most interactions that a run was given, by task.
        rng: draws the pairs of the bootstrap.
        draws: how many samples.
        confidence: above 0, below 1.

    Raises:
        ConfigError: if the tasks or the numbers of runs differ, one has no runs or cap, or a time is out of range.
    """
    same_tasks(a, b)
    x, y = _positive("a", a, caps), _positive("b", b, caps)
    whole("draws", draws, 1)
    by_task: dict[str, Bounds] = {}
    point, lows, highs = np.zeros(2), np.zeros(draws), np.zeros(draws)
    for task, runs in x.items():
        others = y[task]
        if len(runs) != len(others):
            raise ConfigError(f"{task}: expected pairs, got {len(runs)} runs of a and {len(others)} of b")
        low, high = _log_ratios(runs[np.newaxis], others[np.newaxis], caps[task])
        by_task[task] = Bounds(float(np.exp(low[0])), float(np.exp(high[0])))
        point += np.array([low[0], high[0]]) / len(x)
        chosen = rng.integers(len(runs), size=(draws, len(runs)))
        low, high = _log_ratios(runs[chosen], others[chosen], caps[task])
        lows += low / len(x)
        highs += high / len(x)
    at_least, at_most = (float(end) for end in np.exp(point))
    low_end = min(at_least, float(np.exp(percentiles(lows, confidence)[0])))
    high_end = max(at_most, float(np.exp(percentiles(highs, confidence)[1])))
    return RatioOfMedians(Bounds(at_least, at_most), Interval(low_end, high_end), by_task)


def _positive(name: str, times: RunsByTask, caps: Mapping[str, float]) -> dict[str, Floats]:
    runs = solving_times(name, times, caps)
    for task, each in runs.items():
        if (each == 0).any():
            raise ConfigError(f"{name} of {task}: expected times above 0 to divide by, got 0")
    return runs


def _log_ratios(a: Floats, b: Floats, cap: float) -> tuple[Floats, Floats]:
    """The least and the greatest that log(median(a) / median(b)) can be [draws]; a and b are [draws, runs]."""
    (a_low, a_high), (b_low, b_high) = (
        (np.log(np.median(np.minimum(runs, cap), axis=1)), np.log(np.median(runs, axis=1))) for runs in (a, b)
    )
    return a_low - b_high, a_high - b_low
