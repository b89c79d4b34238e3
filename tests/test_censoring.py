"""Times to solve with unsolved runs, against textbook values, plain fractions and enumeration."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.statistics.censoring import kaplan_meier_median, restricted_mean, times_or_never

# Weeks in remission under 6-mercaptopurine and placebo (Freireich et al., 1963), the usual textbook example.
DRUG_ENDED = {6: 3, 7: 1, 10: 1, 13: 1, 16: 1, 22: 1, 23: 1}
DRUG_CENSORED = [6, 9, 10, 11, 17, 19, 20, 25, 32, 32, 34, 35]
PLACEBO = [1, 1, 2, 2, 3, 4, 4, 5, 5, 8, 8, 8, 8, 11, 11, 12, 12, 15, 17, 22, 23]
CAP = 50

runs_with_cap = st.lists(st.tuples(st.integers(0, CAP), st.booleans()), min_size=1, max_size=12)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def drug() -> tuple[list[int], list[bool]]:
    ended = [time for time, count in DRUG_ENDED.items() for _ in range(count)]
    return ended + DRUG_CENSORED, [True] * len(ended) + [False] * len(DRUG_CENSORED)


def survival(runs: list[tuple[int, bool]], at: int) -> Fraction:
    """The product-limit estimate by its definition."""
    left = Fraction(1)
    for time in sorted({time for time, solved in runs if solved and time <= at}):
        at_risk = sum(each >= time for each, _ in runs)
        left *= 1 - Fraction(sum(run == (time, True) for run in runs), at_risk)
    return left


def test_the_textbook_medians_are_found() -> None:
    assert kaplan_meier_median(*drug()) == 23
    assert kaplan_meier_median(PLACEBO, [True] * 21) == 8


@given(runs=runs_with_cap)
def test_the_median_is_where_the_curve_has_fallen_to_one_half(runs: list[tuple[int, bool]]) -> None:
    below = [time for time in range(CAP + 1) if survival(runs, time) <= Fraction(1, 2)]
    assert kaplan_meier_median(*zip(*runs, strict=True)) == (below[0] if below else None)


@given(times=st.lists(st.integers(0, CAP), min_size=1, max_size=20))
def test_without_censoring_it_is_the_median(times: list[int]) -> None:
    assert kaplan_meier_median(times, [True] * len(times)) == np.quantile(times, 0.5, method="inverted_cdf")


@pytest.mark.parametrize("solved", range(2, 41, 2))
def test_half_of_the_runs_are_enough_for_a_median_and_one_less_is_not(solved: int) -> None:
    runs = 2 * solved
    times = [*range(1, solved + 1), *[CAP] * solved]
    assert kaplan_meier_median(times, [True] * solved + [False] * solved) == solved
    assert kaplan_meier_median([*times, CAP], [True] * solved + [False] * (runs + 1 - solved)) is None


def test_one_half_is_reached_in_spite_of_rounding() -> None:
    """Runs that stop early make the curve a product: one of these is 0.5 only but for its last digit."""
    for early in range(1, 30):
        for at_risk in range(2, 40, 2):
            times = [1] * early + list(range(2, 2 + at_risk))
            solved = [False] * early + [True] * (at_risk // 2) + [False] * (at_risk // 2)
            assert kaplan_meier_median(times, solved) == 1 + at_risk // 2


def test_the_restricted_mean_of_the_textbook_is_the_area_by_hand() -> None:
    runs = list(zip(*drug(), strict=True))
    area = sum(survival(runs, week) for week in range(35))
    estimate = restricted_mean(*drug(), 35, rng(), draws=200)
    assert estimate.value == pytest.approx(float(area))
    assert estimate.value == pytest.approx(23.3, abs=0.05)


@given(runs=runs_with_cap)
def test_the_restricted_mean_is_the_area_under_the_curve(runs: list[tuple[int, bool]]) -> None:
    estimate = restricted_mean(*zip(*runs, strict=True), CAP, rng(), draws=100)
    assert estimate.value == pytest.approx(float(sum(survival(runs, time) for time in range(CAP))))
    assert 0 <= estimate.interval.low <= estimate.value <= estimate.interval.high <= CAP


@given(times=st.lists(st.integers(0, 2 * CAP), min_size=1, max_size=12))
def test_if_unsolved_runs_stop_at_the_cap_it_is_a_plain_mean(times: list[int]) -> None:
    spent = np.minimum(times, CAP)
    estimate = restricted_mean(spent, np.array(times) <= CAP, CAP, rng(), draws=10)
    assert estimate.value == pytest.approx(spent.mean())


def test_its_interval_is_that_of_all_samples() -> None:
    runs = [(5, True), (5, False), (20, True), (30, True)]
    areas = sorted(
        float(sum(survival(list(drawn), time) for time in range(CAP))) for drawn in itertools.product(runs, repeat=4)
    )
    expected = areas[math.floor(0.025 * 255)], areas[math.ceil(0.975 * 255)]
    interval = restricted_mean(*zip(*runs, strict=True), CAP, rng(), draws=20_000).interval
    assert (interval.low, interval.high) == pytest.approx(expected)


def test_its_interval_covers_the_mean() -> None:
    """min(T, 1) of an exponential T of mean 1 has mean 1 - 1/e; 20 runs."""
    chance = rng(3)
    inside = 0
    for _ in range(400):
        times = chance.exponential(size=20)
        inside += 1 - math.exp(-1) in restricted_mean(np.minimum(times, 1), times < 1, 1, chance, draws=400).interval
    assert inside / 400 == pytest.approx(0.94, abs=0.03)


@given(runs=runs_with_cap)
def test_the_order_of_the_runs_does_not_matter(runs: list[tuple[int, bool]]) -> None:
    one, other = (zip(*order, strict=True) for order in (runs, runs[::-1]))
    (times, solved), (other_times, other_solved) = one, other
    assert kaplan_meier_median(times, solved) == kaplan_meier_median(other_times, other_solved)
    values = [restricted_mean(*each, CAP, rng(), draws=50) for each in ((times, solved), (other_times, other_solved))]
    assert values[0] == values[1]


def test_unsolved_runs_never_solve() -> None:
    assert times_or_never([3, 10, 10], [True, False, True], 10).tolist() == [3, math.inf, 10]


@pytest.mark.parametrize(
    ("times", "solved", "text"),
    [
        ([], [], "times: expected a vector of at least one number"),
        ([[1]], [[True]], r"got an array of shape \(1, 1\)"),
        ([1, math.nan], [1, 1], "times: expected finite numbers from 0 to 10, got nan at index 1"),
        ([math.inf], [1], "got inf"),
        ([11], [1], "from 0 to 10, got 11 at index 0"),
        ([-1], [1], "got -1"),
        (["fast"], [1], "times: expected numbers"),
        ([1, 2], [True], "the same number of times and solved, got 2 times, 1 solved"),
        ([1], [2], "solved: expected a vector of true and false"),
    ],
)
def test_impossible_runs_are_refused(times: list[float], solved: list[int], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        restricted_mean(times, solved, 10, rng())
    with pytest.raises(ConfigError, match=text):
        times_or_never(times, solved, 10)
    if times != [11]:
        with pytest.raises(ConfigError, match=text.replace("from 0 to 10", "of at least 0")):
            kaplan_meier_median(times, solved)


@pytest.mark.parametrize("cap", [0, -1, math.inf, math.nan])
def test_a_cap_is_a_number_above_zero(cap: float) -> None:
    with pytest.raises(ConfigError, match="cap: expected a finite number above 0"):
        restricted_mean([1], [True], cap, rng())


def test_a_run_that_was_given_less_than_the_cap_cannot_be_ranked() -> None:
    with pytest.raises(ConfigError, match="expected unsolved runs to stop at the cap of 10, got 4"):
        times_or_never([3, 4], [True, False], 10)
