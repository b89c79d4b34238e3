"""Interactions until a task is solved, where some runs reach their cap unsolved (right-censored).

The cap of such a run is not a measurement: all that is known is that it would have taken longer.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import CensoredData, ecdf

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.statistics.bootstrap import CONFIDENCE, DRAWS, Estimate, percentile_estimate, resampled_counts
from t4nmtd_dist.statistics.inputs import Bools, Floats, flags, number, same_length, vector, whole

# A survival of 0.5 is a product of fractions, which rounding may leave above it.
ROUNDING = 1e-9


def kaplan_meier_median(times: ArrayLike, solved: ArrayLike) -> float | None:
    """First time at which the Kaplan-Meier survival curve is at most 0.5; None if it never is.

    If every run is solved, that is the median; of an even number of runs, the lower of the two in the middle.

    Args:
        times: interactions until the run was solved or stopped [runs].
        solved: whether it was solved [runs].

    Raises:
        ConfigError: if there is no run, a time is negative or no number, or the lengths differ.
    """
    known, over = _checked(times, solved, np.inf)
    curve = ecdf(CensoredData.right_censored(known, ~over)).sf
    fallen = np.asarray(curve.probabilities) <= 0.5 + ROUNDING
    return float(curve.quantiles[fallen.argmax()]) if fallen.any() else None


def restricted_mean(
    times: ArrayLike,
    solved: ArrayLike,
    cap: float,
    rng: np.random.Generator,
    *,
    draws: int = DRAWS,
    confidence: float = CONFIDENCE,
) -> Estimate:
    """Mean interactions spent up to the cap: the area under the Kaplan-Meier curve on [0, cap].

    If all unsolved runs stopped at the cap, it is the mean of min(time, cap). If the last run stopped unsolved before
    the cap, the curve keeps its last value. With no run solved it is the cap and says nothing; print the share instead.

    Args:
        times: interactions until the run was solved or stopped [runs].
        solved: whether it was solved [runs].
        cap: the most interactions that a run was given.
        rng: draws the runs of the bootstrap.
        draws: how many samples.
        confidence: above 0, below 1.

    Raises:
        ConfigError: if there is no run, a time is out of [0, cap], or the lengths differ.
    """
    known, over = _checked(times, solved, number("cap", cap, 0, np.inf))
    whole("draws", draws, 1)
    order = np.lexsort((~over, known))  # at equal times, what is solved comes before what is censored
    known, over = known[order], over[order]
    value = float(_areas(np.ones((1, len(known))), known, over, cap)[0])
    samples = _areas(resampled_counts(len(known), draws, rng), known, over, cap)
    return percentile_estimate(value, samples, (float(known[0]), cap), confidence)


def _areas(counts: Floats, times: Floats, solved: Bools, cap: float) -> Floats:
    """Area under the Kaplan-Meier curve for each sample, float64 [draws].

    Args:
        counts: how often each run is in the sample [draws, runs].
        times: rising [runs].
        solved: [runs].
        cap: end of the area.
    """
    at_risk = np.cumsum(counts[:, ::-1], axis=1)[:, ::-1]
    left = np.where(solved & (counts > 0), (at_risk - counts) / np.maximum(at_risk, 1), 1.0)
    survival = np.cumprod(left, axis=1)
    return np.asarray(times[0] + survival @ np.diff(times, append=cap))


def times_or_never(times: ArrayLike, solved: ArrayLike, cap: float) -> Floats:
    """Interactions to solve, infinity for a run that was not solved within its cap, float64 [runs].

    Their negatives order runs as a comparison wants them: the sooner solved the better, two unsolved runs alike.

    Raises:
        ConfigError: if there is no run, a time is out of [0, cap], the lengths differ, or an unsolved run was given
            less than the cap, so that its place among the others is unknown.
    """
    known, over = _checked(times, solved, number("cap", cap, 0, np.inf))
    early = ~over & (known < cap)
    if early.any():
        raise ConfigError(
            f"times: expected unsolved runs to stop at the cap of {cap:g}, got {known[early][0]:g}; give them the rest"
        )
    return np.where(over, known, np.inf)


def _checked(times: ArrayLike, solved: ArrayLike, cap: float) -> tuple[Floats, Bools]:
    known, over = vector("times", times, 0, cap), flags("solved", solved)
    same_length(times=known, solved=over)
    return known, over
