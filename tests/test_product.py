"""Rewards of a change of DFA state, against a slow restatement of the specification."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_tasks import small_task

from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.config import Shaping
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.rewards import SubtaskTables, SymbolReader, subtask_tables
from t4nmtd_dist.tasks import load_task

GAMMA = 0.9
SHAPINGS: list[Shaping] = ["paper", "potential", "subtask"]
CASES = [(task, shaping) for task in ("task5", "task7", "task8") for shaping in SHAPINGS]


def compiled(name: str) -> CompiledTask:
    return small_task() if name == "task7" else compile_task(load_task(name))


def tables(task: CompiledTask, pid: str, shaping: Shaping) -> SubtaskTables:
    return subtask_tables(task.dfa, task.decomposition, pid, task.rho, gamma=GAMMA, shaping=shaping)


def expected_reward(task: CompiledTask, pid: str, shaping: Shaping, q: int, q_next: int) -> float:
    """Section "Low level", step 2, word by word."""
    accepts = q_next in task.dfa.accepting and q_next != q
    reward = 100.0 if accepts else 0.0
    reached = q_next in task.decomposition.q_target(pid, q)
    if shaping == "paper":
        return float(reward + GAMMA * task.rho[q_next] - task.rho[q]) if reached else 0.0
    if shaping == "subtask":
        return (100.0 if accepts else 10.0) if reached else 0.0
    rho = [0.0 if state in task.terminal else float(task.rho[state]) for state in range(task.dfa.states)]
    return reward + GAMMA * rho[q_next] - rho[q]


@pytest.mark.parametrize(("name", "shaping"), CASES)
def test_every_reward_is_the_specified_one(name: str, shaping: Shaping) -> None:
    task = compiled(name)
    for pid in task.decomposition.pids:
        found = tables(task, pid, shaping).reward
        for q in range(task.dfa.states):
            for q_next in range(task.dfa.states):
                expected = expected_reward(task, pid, shaping, q, q_next)
                assert found[q, q_next] == pytest.approx(expected), (pid, q, q_next)


@pytest.mark.parametrize(("name", "shaping"), CASES)
def test_transitions_into_an_error_state_are_never_paid(name: str, shaping: Shaping) -> None:
    """Trap: an error state treated as a goal."""
    task = compiled(name)
    errors = sorted(task.dfa.error)
    alive = sorted(set(range(task.dfa.states)) - task.dfa.error)
    for pid in task.decomposition.pids:
        made = tables(task, pid, shaping)
        assert not made.target[:, errors].any()
        assert (made.reward[np.ix_(alive, errors)] <= 0).all()
        assert made.terminal[errors].all()


@pytest.mark.parametrize(("name", "shaping"), CASES)
def test_the_error_penalty_is_taken_off_once_where_an_error_state_is_entered(name: str, shaping: Shaping) -> None:
    task = compiled(name)
    entered = np.zeros((task.dfa.states, task.dfa.states), np.bool_)
    entered[np.ix_(sorted(set(range(task.dfa.states)) - task.dfa.error), sorted(task.dfa.error))] = True
    assert entered.any()
    for pid in task.decomposition.pids:
        given = (task.dfa, task.decomposition, pid, task.rho)
        punished = subtask_tables(*given, gamma=GAMMA, shaping=shaping, error_penalty=7.0).reward
        assert np.array_equal(punished, tables(task, pid, shaping).reward - 7.0 * entered)


@pytest.mark.parametrize("name", ["task7", "task8"])
def test_masks_say_what_the_automaton_says(name: str) -> None:
    task = compiled(name)
    for pid in task.decomposition.pids:
        made = tables(task, pid, "paper")
        for q in range(task.dfa.states):
            assert made.available[q] == (pid in task.decomposition.available(q))
            assert set(np.flatnonzero(made.target[q])) == task.decomposition.q_target(pid, q)
            assert (made.accepting[q], made.error[q]) == (q in task.dfa.accepting, q in task.dfa.error)


@settings(max_examples=80)
@given(symbols=st.lists(st.integers(0, 15), min_size=1, max_size=30), ends=st.booleans())
def test_potential_shaping_telescopes_on_every_walk(symbols: list[int], ends: bool) -> None:
    """The discounted sum is that of the bare rewards less rho at the start, however the walk ends.

    What is left over at the end of an unfinished walk is gamma^n rho there, which the critic's value holds.
    """
    task = small_task()
    made = tables(task, "p1", "potential")
    q, total, bare, weight = task.dfa.initial, 0.0, 0.0, 1.0
    start = float(task.rho[q])
    for step, symbol in enumerate(symbols):
        q_next = int(task.dfa.delta[q, symbol])
        total += weight * made.reward[q, q_next]
        bare += weight * 100.0 * (q_next in task.dfa.accepting)
        over = q_next in task.terminal
        if ends and not over and step == len(symbols) - 1:
            total -= weight * made.carried_potential[q_next]  # the environment ended here
        weight *= GAMMA
        q = q_next
        if over:
            break
    left = 0.0 if q in task.terminal or ends else weight * float(task.rho[q])
    assert total == pytest.approx(bare - start + left, abs=1e-9)


@pytest.mark.parametrize("shaping", ["paper", "subtask"])
def test_only_potential_shaping_takes_anything_off_where_the_environment_ends(shaping: Shaping) -> None:
    assert not tables(small_task(), "p1", shaping).carried_potential.any()


def test_nothing_but_the_reward_depends_on_the_shaping() -> None:
    """Trap: an ablation that also changes something else."""
    made = [tables(small_task(), "p2", shaping) for shaping in SHAPINGS]
    for name in ("target", "available", "accepting", "error", "terminal"):
        assert all(np.array_equal(getattr(made[0], name), getattr(other, name)) for other in made)


# Symbols


@st.composite
def worlds_and_formulas(draw: st.DrawFn) -> tuple[DFA, tuple[str, ...]]:
    """An environment's propositions in any order, and an automaton over some of them."""
    names = draw(st.permutations(["z", "a", "m", "g1", "g2"]))
    used = tuple(sorted(draw(st.sets(st.sampled_from(names), min_size=1))))
    return DFA(used, np.zeros((1, 1 << len(used)), np.int32), frozenset()), tuple(names)


@settings(max_examples=60)
@given(worlds_and_formulas(), st.lists(st.lists(st.booleans(), min_size=5, max_size=5), min_size=1, max_size=6))
def test_letters_do_not_depend_on_the_order_of_the_columns(
    pair: tuple[DFA, tuple[str, ...]], rows: list[list[bool]]
) -> None:
    dfa, propositions = pair
    symbols = SymbolReader(dfa, propositions).symbols(np.array(rows))
    for row, symbol in zip(rows, symbols, strict=True):
        assert symbol == dfa.symbol(name for name, holds in zip(propositions, row, strict=True) if holds)


def test_a_proposition_that_the_world_never_reports_is_refused_by_name() -> None:
    dfa = small_task().dfa
    with pytest.raises(EnvError, match="'g'"):
        SymbolReader(dfa, ("p1", "p2", "p3"))


def test_a_subtask_of_ones_own_works_without_a_task() -> None:
    delta = np.array([[0, 1], [1, 1]], np.int32)
    dfa = DFA(("a",), delta, frozenset({1}))
    made = subtask_tables(
        dfa, Decomposition({"a": ((0, 1),)}), "a", np.array([50.0, 100.0]), gamma=1.0, shaping="paper"
    )
    assert made.reward.tolist() == [[0.0, 150.0], [0.0, 0.0]]
