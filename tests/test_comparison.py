"""Comparisons of methods and ratios of times, against scipy, enumeration and published examples."""

from __future__ import annotations

import itertools
import math
from statistics import geometric_mean, median

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.statistics.bootstrap import Estimate, Interval
from t4nmtd_dist.statistics.censoring import times_or_never
from t4nmtd_dist.statistics.comparison import (
    compare,
    holm,
    permutation_p_value,
    probability_of_improvement,
    verdict,
)
from t4nmtd_dist.statistics.ratios import Bounds, ratio_of_medians

NEVER = math.inf
Runs = dict[str, list[float]]

few_values = st.lists(st.sampled_from([-NEVER, 0.0, 1.0, 2.5, 3.0]), min_size=1, max_size=5)
methods = st.dictionaries(st.sampled_from(["task1", "task2", "task3"]), st.tuples(few_values, few_values), min_size=1)
p_values = st.lists(st.floats(0, 1), min_size=1, max_size=8)
CAP = 100.0
time = st.floats(1, CAP) | st.just(NEVER)
pairs = st.dictionaries(
    st.sampled_from(["task1", "task2", "task3"]), st.lists(st.tuples(time, time), min_size=1, max_size=5), min_size=1
)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def split(by_task: dict[str, tuple[list[float], list[float]]]) -> tuple[Runs, Runs]:
    return {task: a for task, (a, _) in by_task.items()}, {task: b for task, (_, b) in by_task.items()}


def wins(a: list[float], b: list[float]) -> float:
    return sum((x > y) + (x == y) / 2 for x in a for y in b) / (len(a) * len(b))


# Probability of improvement


@given(by_task=methods)
def test_the_probability_is_the_mean_share_of_won_pairs(by_task: dict[str, tuple[list[float], list[float]]]) -> None:
    estimate = probability_of_improvement(*split(by_task), rng(), draws=50)
    assert estimate.value == pytest.approx(np.mean([wins(a, b) for a, b in by_task.values()]))
    assert 0 <= estimate.interval.low <= estimate.value <= estimate.interval.high <= 1


def test_the_probability_is_the_mann_whitney_statistic_of_scipy() -> None:
    a, b = rng(1).integers(8, size=7), rng(2).integers(8, size=9)
    expected = mannwhitneyu(a, b).statistic / 63
    assert probability_of_improvement({"task1": a}, {"task1": b}, rng()).value == pytest.approx(expected)


@given(by_task=methods)
def test_with_the_names_exchanged_the_probabilities_add_up_to_one(
    by_task: dict[str, tuple[list[float], list[float]]],
) -> None:
    a, b = split(by_task)
    one, other = (probability_of_improvement(*each, rng(), draws=2) for each in ((a, b), (b, a)))
    assert one.value + other.value == pytest.approx(1)
    assert permutation_p_value(a, a, rng(), draws=20) == 1


def test_two_unsolved_runs_tie_and_an_unsolved_one_loses() -> None:
    ours = -times_or_never([5, 10, 10], [True, True, False], 10)
    theirs = -times_or_never([10, 10], [False, False], 10)
    assert probability_of_improvement({"t": ours}, {"t": theirs}, rng()).value == pytest.approx((4 + 2 / 2) / 6)
    assert probability_of_improvement({"t": theirs}, {"t": theirs}, rng()).value == 0.5


def test_the_interval_is_that_of_all_samples_within_tasks_and_methods() -> None:
    a, b = {"t": [1.0, 4.0], "u": [2.0]}, {"t": [2.0, 3.0], "u": [1.0, 5.0]}
    drawn = [
        (wins(list(one), list(two)) + wins([2.0], list(three))) / 2
        for one in itertools.product(a["t"], repeat=2)
        for two in itertools.product(b["t"], repeat=2)
        for three in itertools.product(b["u"], repeat=2)
    ]
    low, high = np.quantile(drawn, [0.1, 0.9], method="inverted_cdf")
    interval = probability_of_improvement(a, b, rng(), confidence=0.8, draws=20_000).interval
    assert (interval.low, interval.high) == pytest.approx((low, high))


def test_the_interval_covers_one_half_for_equal_methods() -> None:
    chance = rng(6)
    inside = 0
    for _ in range(400):
        a, b = ({task: chance.random(10) for task in "tuv"} for _ in range(2))
        inside += 0.5 in probability_of_improvement(a, b, chance, draws=300).interval
    assert inside / 400 == pytest.approx(0.93, abs=0.035)


# Permutation test


def exact_p(a: Runs, b: Runs) -> float:
    """Share of all ways to deal the runs of each task to the two methods that are as extreme as the real one."""
    dealt = []
    for task, runs in a.items():
        pooled = runs + b[task]
        every = range(len(pooled))
        dealt.append(
            [wins([pooled[i] for i in chosen], [pooled[i] for i in every if i not in chosen])
             for chosen in itertools.combinations(every, len(runs))]
        )  # fmt: skip
    means = [abs(np.mean(each) - 0.5) for each in itertools.product(*dealt)]
    return float(np.mean([mean >= means[0] - 1e-9 for mean in means]))


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ({"t": [4, 5, 6]}, {"t": [1, 2, 3]}),  # by hand: 2 of 20
        ({"t": [1, 2, 3]}, {"t": [4, 5, 6]}),
        ({"t": [4, 5, 1], "u": [7, 8, 3]}, {"t": [1, 2, 3], "u": [1, 2, 3, 7]}),
        ({"t": [-NEVER, 5], "u": [1, 1]}, {"t": [-NEVER, -NEVER, 1], "u": [1, 1]}),
    ],
)
def test_the_p_value_is_that_of_all_permutations_within_tasks(a: Runs, b: Runs) -> None:
    assert permutation_p_value(a, b, rng(), draws=20_000) == pytest.approx(exact_p(a, b), abs=0.01)


def test_tasks_are_never_mixed() -> None:
    """Differences between tasks are far greater than between methods: mixed permutations would hide the latter."""
    a = {"t": [11.0, 12, 13, 14], "u": [1.0, 2, 3, 4]}
    b = {"t": [10.0, 9, 8, 7], "u": [0.0, -1, -2, -3]}
    assert permutation_p_value(a, b, rng()) == pytest.approx(2 / math.comb(8, 4) ** 2, abs=5e-4)


def test_a_p_value_is_never_zero() -> None:
    a, b = {"t": list(range(20, 40))}, {"t": list(range(20))}
    assert permutation_p_value(a, b, rng(), draws=99) == pytest.approx(0.01)


def test_equal_methods_are_rarely_told_apart() -> None:
    chance = rng(9)
    found = 0
    for _ in range(400):
        a, b = ({task: chance.random(5) for task in "tu"} for _ in range(2))
        found += permutation_p_value(a, b, chance, draws=199) < 0.05
    assert 0.02 <= found / 400 <= 0.08


# Holm's correction


def test_holm_of_the_usual_example() -> None:
    """By hand: 4 x 0.005, 3 x 0.01, 2 x 0.03, and then no less for 0.04."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])


@given(p=p_values)
def test_adjusted_p_values_keep_the_order_and_lie_between_plain_and_bonferroni(p: list[float]) -> None:
    adjusted = holm(p)
    assert (np.diff(adjusted[np.argsort(p, kind="stable")]) >= 0).all()
    assert (adjusted >= p).all()
    assert (adjusted <= np.minimum(1, np.array(p) * len(p))).all()


@given(p=p_values, level=st.floats(0.001, 0.999))
def test_adjusted_p_values_are_below_the_level_where_the_stepwise_procedure_rejects(
    p: list[float], level: float
) -> None:
    rejected: set[int] = set()
    for step, index in enumerate(sorted(range(len(p)), key=p.__getitem__)):
        if p[index] * (len(p) - step) >= level:
            break
        rejected.add(index)
    assert {int(index) for index in np.flatnonzero(holm(p) < level)} == rejected


@given(p=p_values, index=st.integers(0, 7), smaller=st.floats(0, 1))
def test_a_smaller_p_value_never_raises_another(p: list[float], index: int, smaller: float) -> None:
    changed = list(p)
    changed[index % len(p)] *= smaller
    assert (holm(changed) <= holm(p)).all()


# The verdict


@pytest.mark.parametrize(
    ("low", "high", "adjusted", "expected"),
    [
        (0.51, 0.9, 0.049, "better"),
        (0.51, 0.9, 0.05, "undecided"),
        (0.5, 0.9, 0.001, "undecided"),
        (0.1, 0.49, 0.049, "worse"),
        (0.1, 0.49, 0.05, "undecided"),
        (0.1, 0.5, 0.001, "undecided"),
    ],
)
def test_better_needs_both_the_interval_and_the_test(low: float, high: float, adjusted: float, expected: str) -> None:
    assert verdict(Estimate((low + high) / 2, Interval(low, high)), adjusted) == expected


def test_methods_are_compared_with_one_correction_for_all() -> None:
    ours = {task: rng(1).random(10) + 0.5 for task in "tuv"}
    others = {
        "far below": {task: rng(2).random(10) for task in "tuv"},
        "the same": ours,
        "far above": {task: rng(3).random(10) + 1 for task in "tuv"},
    }
    found = compare(ours, others, rng(), draws=2000)
    assert {name: each.verdict for name, each in found.items()} == {
        "far below": "better", "the same": "undecided", "far above": "worse",
    }  # fmt: skip
    assert [each.adjusted for each in found.values()] == holm([each.p_value for each in found.values()]).tolist()
    assert found["far below"].adjusted == 3 * found["far below"].p_value


def test_what_is_better_alone_need_not_be_so_among_many_comparisons() -> None:
    """Four runs above four others: by hand p = 2/70, times six 0.17."""
    ours, theirs = {"t": [5, 6, 7, 8]}, {"t": [1, 2, 3, 4]}
    [alone] = compare(ours, {"other": theirs}, rng()).values()
    among = compare(ours, {f"other {number}": theirs for number in range(6)}, rng())
    assert alone.verdict == "better"
    assert {each.verdict for each in among.values()} == {"undecided"}
    assert [each.adjusted for each in among.values()] == pytest.approx([12 / 70] * 6, abs=0.03)


def test_three_runs_of_one_task_decide_nothing_however_far_apart() -> None:
    [found] = compare({"t": [4, 5, 6]}, {"other": {"t": [1, 2, 3]}}, rng()).values()
    assert found.probability == Estimate(1, Interval(1, 1))
    assert found.verdict == "undecided"


@pytest.mark.parametrize(
    ("a", "b", "text"),
    [
        ({}, {}, "a: expected the runs of at least one task, got none"),
        ({"t": [1]}, {"u": [1]}, r"a and b: expected the same tasks, got \['t'\] and \['u'\]"),
        ({"t": [1]}, {"t": []}, "b of t: expected a vector of at least one number"),
        ({"t": [1, math.nan]}, {"t": [1]}, "a of t: expected numbers, got nan at index 1"),
    ],
)
def test_impossible_comparisons_are_refused(a: Runs, b: Runs, text: str) -> None:
    for function in (probability_of_improvement, permutation_p_value):
        with pytest.raises(ConfigError, match=text):
            function(a, b, rng())


def test_impossible_p_values_and_no_methods_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"p_values: expected finite numbers from 0 to 1, got 1\.5 at index 1"):
        holm([0.5, 1.5])
    with pytest.raises(ConfigError, match="p_values: expected a vector of at least one number"):
        holm([])
    with pytest.raises(ConfigError, match="at least one method to compare with, got none"):
        compare({"t": [1]}, {}, rng())


# Ratios of paired times


def unpaired(by_task: dict[str, list[tuple[float, float]]]) -> tuple[Runs, Runs, dict[str, float]]:
    a = {task: [one for one, _ in runs] for task, runs in by_task.items()}
    b = {task: [other for _, other in runs] for task, runs in by_task.items()}
    return a, b, dict.fromkeys(by_task, CAP)


def test_the_ratio_is_the_geometric_mean_of_the_tasks() -> None:
    a, b = {"t": [2, 8, 4], "u": [9, 27]}, {"t": [1, 3, 2], "u": [1, 3]}
    found = ratio_of_medians(a, b, {"t": 100, "u": 100}, rng())
    expected = geometric_mean([median(a[task]) / median(b[task]) for task in a])
    assert (found.ratio.at_least, found.ratio.at_most) == pytest.approx((expected, expected))
    assert {task: each.at_least for task, each in found.by_task.items()} == pytest.approx({"t": 2, "u": 9})


@given(by_task=pairs)
def test_an_interval_contains_the_ratio_and_exchanging_the_names_inverts_all(
    by_task: dict[str, list[tuple[float, float]]],
) -> None:
    a, b, caps = unpaired(by_task)
    found, inverse = (ratio_of_medians(*each, caps, rng(), draws=1) for each in ((a, b), (b, a)))
    assert 0 <= found.interval.low <= found.ratio.at_least <= found.ratio.at_most <= found.interval.high
    for one, other in (
        (found.ratio.at_least, inverse.ratio.at_most),
        (found.interval.low, inverse.interval.high),
        (found.interval.high, inverse.interval.low),
    ):
        assert one == pytest.approx(math.inf if other == 0 else 1 / other)


@given(by_task=pairs, later=st.lists(st.floats(CAP, 1000 * CAP), min_size=30, max_size=30))
def test_whatever_unsolved_runs_would_have_taken_lies_within_the_bounds(
    by_task: dict[str, list[tuple[float, float]]], later: list[float]
) -> None:
    found = ratio_of_medians(*unpaired(by_task), rng(), draws=2)
    taken = iter(later)
    a, b, _ = unpaired(by_task)
    full = [
        {task: [next(taken) if one == NEVER else one for one in runs] for task, runs in times.items()}
        for times in (a, b)
    ]
    ratio = geometric_mean([median(full[0][task]) / median(full[1][task]) for task in by_task])
    assert found.ratio.at_least <= ratio * (1 + 1e-9)
    assert ratio <= found.ratio.at_most * (1 + 1e-9)


def test_an_unsolved_median_bounds_the_ratio_from_one_side() -> None:
    found = ratio_of_medians({"t": [20, NEVER, NEVER]}, {"t": [10, 20, 30]}, {"t": 100}, rng())
    assert found.ratio == Bounds(pytest.approx(5), math.inf)
    assert found.interval.high == math.inf
    assert found.interval.low <= 5
    found = ratio_of_medians({"t": [NEVER]}, {"t": [NEVER]}, {"t": 100}, rng())
    assert found.ratio == Bounds(0, math.inf)


def test_pairs_stay_together() -> None:
    """Runs that differ tenfold among seeds, and are twice as long with every seed, leave no doubt of the ratio."""
    b = {"t": [1.0, 3, 10, 30, 70], "u": [2.0, 20, 4, 7]}
    a = {task: [2 * each for each in runs] for task, runs in b.items()}
    found = ratio_of_medians(a, b, {"t": 200, "u": 200}, rng())
    assert (found.interval.low, found.interval.high) == pytest.approx((2, 2))


def test_the_interval_of_the_ratio_is_that_of_all_samples() -> None:
    a, b = [2.0, 8.0, 5.0], [1.0, 3.0, 9.0]
    ratios = [
        math.log(median(a[i] for i in drawn) / median(b[i] for i in drawn))
        for drawn in itertools.product(range(3), repeat=3)
    ]
    low, high = np.exp(np.quantile(ratios, [0.1, 0.9], method="inverted_cdf"))
    interval = ratio_of_medians({"t": a}, {"t": b}, {"t": 10}, rng(), confidence=0.8).interval
    assert (interval.low, interval.high) == pytest.approx((low, high))


def test_the_interval_of_the_ratio_covers_it() -> None:
    chance = rng(4)
    inside = 0
    for _ in range(400):
        a, b = ({task: chance.lognormal(size=10) for task in "tuv"} for _ in range(2))
        caps = dict.fromkeys("tuv", 1e6)
        found = ratio_of_medians(a, b, caps, chance, draws=200)
        inside += 1 in found.interval
    assert inside / 400 == pytest.approx(0.95, abs=0.04)


@pytest.mark.parametrize(
    ("a", "b", "caps", "text"),
    [
        ({"t": [1, 2]}, {"t": [1]}, {"t": 10}, "t: expected pairs, got 2 runs of a and 1 of b"),
        ({"t": [1]}, {"u": [1]}, {"t": 10}, "a and b: expected the same tasks"),
        ({"t": [1]}, {"t": [1]}, {}, "a and caps: expected the same tasks"),
        ({"t": [0]}, {"t": [1]}, {"t": 10}, "a of t: expected times above 0 to divide by, got 0"),
        ({"t": [1]}, {"t": [11]}, {"t": 10}, "b of t: expected finite numbers from 0 to 10, got 11"),
        ({"t": [1]}, {"t": [math.nan]}, {"t": 10}, "b of t: expected numbers of at least 0, got nan"),
        ({}, {}, {}, "a: expected the runs of at least one task, got none"),
    ],
)
def test_impossible_pairs_are_refused(a: Runs, b: Runs, caps: dict[str, float], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        ratio_of_medians(a, b, caps, rng())
