"""The high level: Q(q, T) and the epsilon-greedy choice of a sub-task."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.high_level import QTable

# 0 -a-> 1, 0 -b-> 2, 0 -c-> 3 (accepting); 1 -a-> 3, 2 -b-> 3; 4 is the error state, 5 a state that nothing leaves.
DECOMPOSITION = Decomposition({"a": ((0, 1), (1, 3)), "b": ((0, 2), (2, 3)), "c": ((0, 3),)})
ACCEPTING, ERROR, DEAD_END = 3, 4, 5

rewards = st.floats(-100, 100)


def table(*, alpha: float = 0.1, gamma: float = 0.9, epsilon: float = 0.1, smdp_discount: bool = False) -> QTable:
    return QTable(
        DECOMPOSITION, {ACCEPTING, ERROR}, alpha=alpha, gamma=gamma, epsilon=epsilon, smdp_discount=smdp_discount
    )


def frequencies(q_table: QTable, q: int, draws: int = 4000) -> dict[str | None, float]:
    rng = np.random.default_rng(0)
    return {pid: n / draws for pid, n in Counter(q_table.choose(q, rng) for _ in range(draws)).items()}


def test_unknown_values_are_minus_infinity_but_worth_nothing_to_others() -> None:
    assert table().value(0, "a") == -math.inf
    assert table().best(0) == 0.0


@given(rewards)
def test_the_first_update_sets_the_value(reward: float) -> None:
    q_table = table(alpha=0.1)
    q_table.update(1, "a", reward, ACCEPTING)
    assert q_table.value(1, "a") == reward


@given(rewards, rewards, st.floats(0, 1))
def test_later_updates_move_by_alpha(first: float, second: float, alpha: float) -> None:
    q_table = table(alpha=alpha)
    q_table.update(1, "a", first, ACCEPTING)
    q_table.update(1, "a", second, ACCEPTING)
    assert q_table.value(1, "a") == pytest.approx(first + alpha * (second - first))


def test_the_target_looks_one_decision_ahead() -> None:
    q_table = table(gamma=0.9)
    q_table.update(1, "a", 50.0, ACCEPTING)
    q_table.update(0, "a", 10.0, 1)
    assert q_table.value(0, "a") == pytest.approx(10 + 0.9 * 50)


def test_only_subtasks_available_in_the_next_state_count() -> None:
    q_table = table(gamma=1.0)
    q_table.update(1, "b", 99.0, ACCEPTING)  # b has no transition out of 1
    q_table.update(0, "a", 10.0, 1)
    assert q_table.value(0, "a") == 10.0


@pytest.mark.parametrize("q", [ACCEPTING, ERROR])
def test_accepting_and_error_states_are_worth_nothing(q: int) -> None:
    q_table = table()
    q_table.update(q, "a", 100.0, 1)
    assert q_table.best(q) == 0.0
    q_table.update(0, "a", 7.0, q)
    assert q_table.value(0, "a") == 7.0


@given(st.integers(1, 300))
def test_a_decision_may_be_discounted_by_its_length(steps: int) -> None:
    plain, smdp = table(gamma=0.9), table(gamma=0.9, smdp_discount=True)
    for q_table in (plain, smdp):
        q_table.update(1, "a", 100.0, ACCEPTING)
        q_table.update(0, "a", 0.0, 1, steps)
    assert plain.value(0, "a") == pytest.approx(90.0)
    assert smdp.value(0, "a") == pytest.approx(100 * 0.9**steps)


@given(rewards, st.integers(1, 50))
def test_failures_move_a_value_toward_nothing(value: float, failures: int) -> None:
    q_table = table(alpha=0.1)
    q_table.update(0, "a", value, ERROR)
    for _ in range(failures):
        q_table.fail(0, "a")
    assert q_table.value(0, "a") == pytest.approx(value * 0.9**failures)


def test_a_failure_makes_an_unknown_choice_known_and_worthless() -> None:
    q_table = table()
    q_table.fail(0, "a")
    assert q_table.value(0, "a") == 0.0


def test_choices_are_epsilon_greedy() -> None:
    q_table = table(epsilon=0.3)
    q_table.update(0, "b", 5.0, ACCEPTING)
    q_table.update(0, "a", 1.0, ACCEPTING)
    found = frequencies(q_table, 0)
    assert found["b"] == pytest.approx(0.7 + 0.1, abs=0.03)
    assert found["a"] == pytest.approx(0.1, abs=0.03)
    assert found["c"] == pytest.approx(0.1, abs=0.03)


def test_nothing_known_means_an_even_choice() -> None:
    assert frequencies(table(epsilon=0.0), 0) == pytest.approx({"a": 1 / 3, "b": 1 / 3, "c": 1 / 3}, abs=0.04)


def test_ties_are_broken_evenly() -> None:
    q_table = table(epsilon=0.0)
    for pid in ("a", "c"):
        q_table.update(0, pid, 3.0, ACCEPTING)
    assert frequencies(q_table, 0) == pytest.approx({"a": 0.5, "c": 0.5}, abs=0.04)


def test_the_first_success_does_not_lock_in() -> None:
    """Trap: the first sub-task ever to succeed takes all."""
    q_table = table(epsilon=0.1)
    q_table.update(0, "a", 100.0, ACCEPTING)
    assert set(frequencies(q_table, 0)) == {"a", "b", "c"}


def test_without_a_subtask_there_is_no_choice() -> None:
    q_table = table()
    for q in (ACCEPTING, ERROR, DEAD_END):
        assert q_table.choose(q, np.random.default_rng(0)) is None
        assert q_table.greedy(q) is None


def test_the_greedy_choice_is_the_best_known_one_and_needs_no_luck() -> None:
    q_table = table()
    assert q_table.greedy(0) == "a", "ties by name"
    q_table.update(0, "c", -5.0, ACCEPTING)
    assert q_table.greedy(0) == "c", "known beats unknown"
    q_table.update(0, "b", 2.0, ACCEPTING)
    assert q_table.greedy(0) == "b"


@given(st.dictionaries(st.tuples(st.integers(0, 2), st.sampled_from("abc")), rewards))
def test_entries_go_from_one_table_to_another(values: dict[tuple[int, str], float]) -> None:
    first, second = table(), table()
    for (q, pid), value in values.items():
        first.update(q, pid, value, ACCEPTING)
    second.update(0, "a", 1.0, ERROR)
    second.load(first.entries())
    assert second.entries() == first.entries() == sorted((q, pid, value) for (q, pid), value in values.items())
