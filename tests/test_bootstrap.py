"""Percentile bootstrap and the exact binomial interval: coverage, range, and agreement with enumeration."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.statistics.bootstrap import Interval, mean_band, percentile_estimate, percentiles
from t4nmtd_dist.statistics.inputs import Floats
from t4nmtd_dist.statistics.proportions import clopper_pearson

binomials = st.integers(1, 40).flatmap(lambda runs: st.tuples(st.integers(0, runs), st.just(runs)))
successes_of_runs = st.lists(st.lists(st.floats(0, 1), min_size=3, max_size=3), min_size=1, max_size=8)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def binomial(least: int, most: int, runs: int, p: float) -> float:
    """P(least <= successes <= most)."""
    return sum(math.comb(runs, k) * p**k * (1 - p) ** (runs - k) for k in range(least, most + 1))


# The share of successes


@given(counts=binomials, confidence=st.floats(0.5, 0.99))
def test_both_ends_of_the_binomial_interval_leave_half_the_rest_to_each_tail(
    counts: tuple[int, int], confidence: float
) -> None:
    successes, runs = counts
    interval = clopper_pearson(successes, runs, confidence)
    assert 0 <= interval.low <= successes / runs <= interval.high <= 1
    tail = (1 - confidence) / 2
    if successes == 0:
        assert interval.low == 0
    else:
        assert binomial(successes, runs, runs, interval.low) == pytest.approx(tail)
    if successes == runs:
        assert interval.high == 1
    else:
        assert binomial(0, successes, runs, interval.high) == pytest.approx(tail)


def test_of_ten_solved_runs_out_of_ten_the_interval_begins_at_seven() -> None:
    """By hand: p^10 = 0.025."""
    assert clopper_pearson(10, 10).low == pytest.approx(0.025**0.1)


@given(counts=binomials)
def test_the_binomial_interval_mirrors_with_failures_for_successes(counts: tuple[int, int]) -> None:
    successes, runs = counts
    interval, mirrored = clopper_pearson(successes, runs), clopper_pearson(runs - successes, runs)
    assert (interval.low, interval.high) == pytest.approx((1 - mirrored.high, 1 - mirrored.low))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((1, 0), "runs: expected a whole number of at least 1, got 0"),
        ((3, 2), "successes: expected a whole number from 0 to 2, got 3"),
        ((-1, 2), "from 0 to 2, got -1"),
        ((0.5, 2), "from 0 to 2, got 0.5"),
        ((math.nan, 2), "from 0 to 2, got nan"),
        ((1, 2, 1.0), "confidence: expected a number below 1 and above 0, got 1.0"),
        ((1, 2, 95), "below 1 and above 0, got 95"),
    ],
)
def test_impossible_counts_are_refused(arguments: tuple[int, ...], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        clopper_pearson(*arguments)


# Percentiles


def test_percentiles_are_samples_and_never_too_close_together() -> None:
    samples = rng().permutation(1001).astype(float)
    assert percentiles(samples, 0.95) == (25, 975)
    assert percentiles(samples[samples < 1000], 0.95) == (24, 975)  # of 0 ... 999: 24.975 and 974.025, outwards


def test_infinite_samples_give_infinite_ends_and_no_nan() -> None:
    samples = np.array([-np.inf] * 30 + [0.0] * 940 + [np.inf] * 30)
    assert percentiles(samples, 0.95) == (-np.inf, np.inf)
    assert percentiles(samples, 0.9) == (0, 0)


@given(value=st.floats(0, 1), samples=st.lists(st.floats(-0.01, 1.01), min_size=1, max_size=9))
def test_an_interval_contains_its_estimate_within_the_limits(value: float, samples: list[float]) -> None:
    estimate = percentile_estimate(value, np.array(samples), (0, 1))
    assert estimate.value == value
    assert 0 <= estimate.interval.low <= value <= estimate.interval.high <= 1


def test_an_interval_includes_its_ends() -> None:
    assert [value in Interval(0.2, 0.4) for value in (0.1, 0.2, 0.3, 0.4, 0.5)] == [False, True, True, True, False]


# The mean of curves


@given(runs=successes_of_runs)
def test_the_interval_of_a_mean_lies_within_the_runs(runs: list[list[float]]) -> None:
    values = np.array(runs)
    band = mean_band(np.arange(3.0), values, rng(), draws=100)
    np.testing.assert_allclose(band.value, values.mean(axis=0))
    assert (band.low <= band.value).all()
    assert (band.value <= band.high).all()
    assert (band.low >= values.min(axis=0) - 1e-12).all()
    assert (band.high <= values.max(axis=0) + 1e-12).all()
    assert (band.low >= 0).all()
    assert (band.high <= 1).all()


def test_four_runs_have_the_interval_of_all_their_256_samples() -> None:
    runs = np.array([0.0, 0.1, 0.3, 1.0])
    means = np.sort([runs[list(np.unravel_index(index, (4,) * 4))].mean() for index in range(4**4)])
    low, high = means[math.floor(0.025 * 255)], means[math.ceil(0.975 * 255)]
    band = mean_band(np.zeros(1), runs[:, np.newaxis], rng(), draws=20_000)
    assert (band.low[0], band.high[0]) == pytest.approx((low, high))


def test_long_curves_are_treated_in_parts_with_the_same_runs_throughout(monkeypatch: pytest.MonkeyPatch) -> None:
    values = rng().random((4, 8))
    whole = mean_band(np.arange(8.0), values, rng(), draws=200)
    monkeypatch.setattr("t4nmtd_dist.statistics.bootstrap.CHUNK", 600)
    parts = mean_band(np.arange(8.0), values, rng(), draws=200)
    np.testing.assert_allclose((parts.low, parts.value, parts.high), (whole.low, whole.value, whole.high))


def test_a_point_without_a_number_leaves_the_others_alone() -> None:
    values = np.array([[0.0, np.nan], [1.0, 1.0]])
    band = mean_band(np.arange(2.0), values, rng(), draws=100)
    assert (band.value[0], band.low[0], band.high[0]) == (0.5, 0, 1)
    assert np.isnan([band.value[1], band.low[1], band.high[1]]).all()


def covered(runs: int, samples: int = 1500) -> float:
    """How often the interval of runs from a normal distribution contains its mean, which is 0."""
    values: Floats = rng(7).normal(size=(runs, samples))
    band = mean_band(np.arange(samples), values, rng(8), draws=1000)
    return float(((band.low <= 0) & (band.high >= 0)).mean())


@pytest.mark.parametrize(("runs", "expected"), [(3, 0.75), (5, 0.84), (10, 0.91), (30, 0.94)])
def test_the_interval_covers_as_often_as_its_documentation_says(runs: int, expected: float) -> None:
    """Of three runs it is their range, which misses the median if all are on one side of it: 1 in 4."""
    assert covered(runs) == pytest.approx(expected, abs=0.025)
