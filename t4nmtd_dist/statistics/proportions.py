"""The share of runs that solved their task."""

from __future__ import annotations

from scipy.stats import binomtest

from t4nmtd_dist.statistics.bootstrap import CONFIDENCE, Interval
from t4nmtd_dist.statistics.inputs import number, whole


def clopper_pearson(successes: int, runs: int, confidence: float = CONFIDENCE) -> Interval:
    """Exact binomial interval of a success probability (Clopper and Pearson, 1934): covers at least ``confidence``.

    Args:
        successes: from 0 to runs.
        runs: at least 1.
        confidence: above 0, below 1.

    Raises:
        ConfigError: if an argument is out of range.
    """
    whole("runs", runs, 1)
    whole("successes", successes, 0, runs)
    number("confidence", confidence, 0, 1)
    ends = binomtest(successes, runs).proportion_ci(confidence, method="exact")
    return Interval(float(ends.low), float(ends.high))
