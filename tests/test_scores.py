"""Scores of runs and their sums over tasks, against values by hand and enumeration."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.statistics.scores import (
    area_under_success,
    interquartile_mean,
    optimality_gap,
    performance_profile,
    share_solved,
)

CAP = 60
evaluations = st.dictionaries(st.integers(0, CAP), st.floats(0, 1), min_size=1, max_size=8)
scores = st.dictionaries(
    st.sampled_from(["task1", "task2", "task3"]), st.lists(st.floats(0, 1), min_size=1, max_size=6), min_size=1
)
NEVER = math.inf


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


# One run


@given(run=evaluations)
def test_the_area_is_what_the_newest_evaluation_says_at_every_interaction(run: dict[int, float]) -> None:
    x = sorted(run)
    said = [next((run[at] for at in reversed(x) if at <= interaction), 0.0) for interaction in range(CAP)]
    area = area_under_success(x, [run[at] for at in x], CAP)
    assert 0 <= area <= 1
    assert area == pytest.approx(sum(said) / CAP)


def test_the_area_of_a_solved_run_by_hand() -> None:
    """0 up to 10, 0.5 up to 20, then 1 up to 100."""
    assert area_under_success([10, 20], [0.5, 1], 100) == pytest.approx(0.05 + 0.8)
    assert area_under_success([0], [1], 100) == 1
    assert area_under_success([100], [1], 100) == 0


@pytest.mark.parametrize(
    ("interactions", "success", "cap", "text"),
    [
        ([], [], 10, "interactions: expected a vector of at least one number"),
        ([1, 11], [0, 1], 10, "interactions: expected finite numbers from 0 to 10, got 11 at index 1"),
        ([1, 2], [0, 1.5], 10, "success: expected finite numbers from 0 to 1, got 1.5 at index 1"),
        ([1], [math.nan], 10, "got nan at index 0"),
        ([1, 2], [0], 10, "the same number of interactions and success, got 2 interactions, 1 success"),
        ([1, 3, 2], [0, 0, 0], 10, "expected rising numbers, got 3 and then 2"),
        ([1, 1], [0, 0], 10, "expected rising numbers, got 1 and then 1"),
        ([1], [0], 0, "cap: expected a finite number above 0, got 0"),
    ],
)
def test_impossible_curves_are_refused(interactions: list[float], success: list[float], cap: float, text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        area_under_success(interactions, success, cap)


# Over tasks


def test_the_interquartile_mean_is_that_of_the_middle_half() -> None:
    runs = {"task1": [0.0, 0.6, 0.2, 1.0], "task2": [0.4, 0.1, 0.5, 0.3]}
    assert interquartile_mean(runs, rng()).value == pytest.approx((0.2 + 0.3 + 0.4 + 0.5) / 4)


def test_the_optimality_gap_counts_what_is_missing_and_nothing_that_is_over() -> None:
    runs = {"task1": [0.2, 1.0], "task2": [0.7]}
    assert optimality_gap(runs, rng()).value == pytest.approx((0.8 + 0 + 0.3) / 3)
    assert optimality_gap(runs, rng(), target=0.5).value == pytest.approx(0.3 / 3)


@given(runs=scores)
def test_intervals_contain_the_estimate_and_stay_in_range(runs: dict[str, list[float]]) -> None:
    for estimate in (interquartile_mean(runs, rng(), draws=1), optimality_gap(runs, rng(), draws=1)):
        assert 0 <= estimate.interval.low <= estimate.value <= estimate.interval.high <= 1


def test_the_interval_is_that_of_all_samples_within_tasks() -> None:
    runs = {"task1": [0.0, 0.4], "task2": [0.5, 1.0]}
    samples = [[*one, *two] for one in itertools.product(runs["task1"], repeat=2)
               for two in itertools.product(runs["task2"], repeat=2)]  # fmt: skip
    middle = sorted(sum(sorted(sample)[1:3]) / 2 for sample in samples)
    interval = interquartile_mean(runs, rng(), confidence=0.8).interval
    assert (interval.low, interval.high) == pytest.approx((middle[1], middle[-2]))


def test_tasks_of_different_difficulty_do_not_widen_the_interval() -> None:
    runs = {"easy": [1.0] * 5, "hard": [0.0] * 5}
    for estimate in (interquartile_mean(runs, rng()), optimality_gap(runs, rng())):
        assert (estimate.value, estimate.interval.low, estimate.interval.high) == (0.5, 0.5, 0.5)


def test_the_interval_of_the_interquartile_mean_covers_it() -> None:
    """Uniform scores in two tasks: the interquartile mean is 0.5."""
    chance = rng(5)
    inside = sum(
        0.5 in interquartile_mean({task: chance.random(10) for task in "ab"}, chance, draws=300).interval
        for _ in range(400)
    )
    assert inside / 400 == pytest.approx(0.93, abs=0.035)


@given(runs=scores, taus=st.lists(st.floats(0, 1), min_size=1, max_size=6))
def test_the_profile_is_the_share_of_runs_above_tau(runs: dict[str, list[float]], taus: list[float]) -> None:
    band = performance_profile(runs, taus, rng(), draws=1)
    pooled = [score for each in runs.values() for score in each]
    assert band.x.tolist() == taus
    assert band.value == pytest.approx([sum(score > tau for score in pooled) / len(pooled) for tau in taus])
    assert (band.low >= 0).all()
    assert (band.low <= band.value).all()
    assert (band.value <= band.high).all()
    assert (band.high <= 1).all()


@pytest.mark.parametrize("tasks", [1, 3, 6, 10, 49])
def test_all_runs_are_exactly_one_whatever_the_number_of_tasks(tasks: int) -> None:
    band = performance_profile({f"task{number}": [1.0] for number in range(tasks)}, [0.5], rng(), draws=10)
    assert (band.low[0], band.value[0], band.high[0]) == (1, 1, 1)


def test_the_band_of_a_profile_is_that_of_all_samples() -> None:
    """Four runs, one above 0.5: none of a sample with (3/4)^4 = 0.316, at least two with 0.262, three with 0.051."""
    band = performance_profile({"task1": [0.1, 0.2, 0.3, 0.9]}, [0.5], rng(), confidence=0.8)
    assert (band.low[0], band.value[0], band.high[0]) == (0, 0.25, 0.5)


def test_the_share_solved_is_measured_in_caps_of_the_task() -> None:
    band = share_solved({"a": [1, 4, NEVER], "b": [50]}, {"a": 4, "b": 100}, [0, 0.25, 0.5, 1], rng())
    assert band.value.tolist() == [0, 0.25, 0.5, 0.75]
    assert band.low[3] == pytest.approx(0.25)  # b is always solved, and a may be drawn without its solved runs
    assert band.high[3] == 1


@pytest.mark.parametrize(
    ("runs", "text"),
    [
        ({}, "scores: expected the runs of at least one task, got none"),
        ({"task1": []}, "scores of task1: expected a vector of at least one number"),
        (
            {"task1": [0.5], "task2": [1.01]},
            "scores of task2: expected finite numbers from 0 to 1, got 1.01 at index 0",
        ),
        ({"task1": [math.nan]}, "scores of task1: .* got nan"),
    ],
)
def test_impossible_scores_are_refused(runs: dict[str, list[float]], text: str) -> None:
    for function in (interquartile_mean, optimality_gap):
        with pytest.raises(ConfigError, match=text):
            function(runs, rng())
    with pytest.raises(ConfigError, match=text):
        performance_profile(runs, [0.5], rng())


def test_impossible_settings_are_refused() -> None:
    runs = {"task1": [0.5]}
    with pytest.raises(ConfigError, match="draws: expected a whole number of at least 1, got 0"):
        interquartile_mean(runs, rng(), draws=0)
    with pytest.raises(ConfigError, match="confidence: expected a number below 1 and above 0, got 95"):
        interquartile_mean(runs, rng(), confidence=95)
    with pytest.raises(ConfigError, match=r"target: .* from 0 to 1, got 2"):
        optimality_gap(runs, rng(), target=2)
    with pytest.raises(ConfigError, match=r"taus: .* from 0 to 1, got -1"):
        performance_profile(runs, [-1], rng())
    with pytest.raises(ConfigError, match=r"times and caps: expected the same tasks, got \['task1'\] and \['task2'\]"):
        share_solved(runs, {"task2": 1}, [0.5], rng())
    with pytest.raises(ConfigError, match=r"times of task1: .* from 0 to 0\.25, got 0\.5"):
        share_solved(runs, {"task1": 0.25}, [0.5], rng())
    with pytest.raises(ConfigError, match="cap of task1: expected a finite number above 0, got 0"):
        share_solved(runs, {"task1": 0}, [0.5], rng())
