"""The baselines' rules in tables: published learning curves in grid worlds, and mistakes that must not reach them.

Scores are reward per step of the last 100 episodes, as a share of the optimum. The bounds are those of the authors' own
results where they have any, else of independent implementations of their rules.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from broken_baselines import (
    ActiveOptionOnly,
    CopiedReward,
    CutAtChange,
    LeavingModule,
    NoTerminalCounterfactuals,
    RealEnd,
    ShiftedState,
    WrongExitGoesOn,
)
from grid_worlds import (
    CORRIDOR_TASK,
    CRAFT_M1_OPTIMUM,
    CRAFT_TASK_10,
    OFFICE_OPTIMUM,
    OFFICE_TASKS,
    corridor,
    craft_m1,
    grid_task,
    office,
    shortest_episode,
)
from tabular import Tabular, UpperTable

from t4nmtd_dist.core.config import LearnerConfig
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.method.options import OptionMethod
from t4nmtd_dist.method.protocol import Method

PAID = 100.0


def unshaped(formula: str, method: str) -> CompiledTask:
    """Acceptance pays 1, nothing else does."""
    task = grid_task(formula, LearnerConfig(method=method, algorithm="dqn", gamma=0.9))
    return replace(task, rho=np.zeros(task.dfa.states))


def rules(task: CompiledTask) -> Method:
    """The method; an option is also paid 1 for its own transition (r_max)."""
    method = task.method()
    if isinstance(method, OptionMethod):
        method.upper = UpperTable(len(method.roles))
        for name, role in method._roles.items():
            tables = role.tables
            paid = PAID * tables.target + PAID * (tables.accepting[None, :] & ~tables.accepting[:, None])
            method._roles[name] = replace(role, tables=replace(tables, reward=paid))
    return method


def learned(learner: type[Tabular], method: str, formula: str, seed: int) -> Tabular:
    task = unshaped(formula, method)
    world = craft_m1() if formula == CRAFT_TASK_10 else corridor() if formula == CORRIDOR_TASK else office()
    return learner(task, rules(task), world, seed=seed)


def office_scores(learner: type[Tabular], method: str, *at: int, seeds: tuple[int, ...] = (0, 1)) -> list[list[float]]:
    return [learned(learner, method, OFFICE_TASKS[3], seed).scores(OFFICE_OPTIMUM, at) for seed in seeds]


def craft_scores(learner: type[Tabular], method: str, *at: int, seed: int = 0) -> list[float]:
    return learned(learner, method, CRAFT_TASK_10, seed).scores(CRAFT_M1_OPTIMUM, at)


# Worlds


def test_shortest_accepted_episodes_are_those_of_the_published_worlds() -> None:
    assert [shortest_episode(office(), unshaped(formula, "crm")) for formula in OFFICE_TASKS.values()] == [
        15, 29, 29, 30
    ]  # fmt: skip
    assert shortest_episode(craft_m1(), unshaped(CRAFT_TASK_10, "crm")) == 55


# Mod


def test_a_module_is_worth_what_the_next_one_makes_of_it() -> None:
    learner = learned(Tabular, "mod", CORRIDOR_TASK, 0)
    learner.table("q1", 1)[0] = [0.25, 0.5]
    symbol = learner.task.dfa.symbol(["a"])
    (lesson,) = learner.lessons("q0", 0, symbol)
    assert (lesson.heir, lesson.q_next, lesson.reward) == ("q1", 1, 0.0)
    assert learner.following_table(lesson) is learner.table("q1", 1)
    learner.cell, before = 1, learner.table("q0", 0)[1][0]
    while learner.q == 0:
        learner.run(learner.steps + 1)
    assert before == 2.0
    assert learner.table("q0", 0)[1][0] == pytest.approx(2.0 + 0.5 * (0.9 * 0.5 - 2.0))


@pytest.mark.parametrize("seed", range(3))
def test_mod_is_product_bit_for_bit(seed: int) -> None:
    mod, product = (learned(Tabular, method, OFFICE_TASKS[3], seed).run(30_000) for method in ("mod", "product"))
    assert mod.episodes == product.episodes
    for q in range(mod.task.dfa.states):
        if f"q{q}" in mod.method.roles:
            assert mod.table(f"q{q}", q) == product.table("policies", q)


@pytest.mark.slow
def test_mod_learns_the_office_only_after_50_000_steps() -> None:
    for early, late in office_scores(Tabular, "mod", 50_000, 75_000):
        assert early <= 0.06
        assert 0.6 <= late <= 0.8


@pytest.mark.slow
def test_a_leaving_modules_own_value_is_myopic() -> None:
    for early, late in office_scores(LeavingModule, "mod", 50_000, 75_000):
        assert 0.5 <= early <= 0.66
        assert late <= 0.66


@pytest.mark.slow
def test_without_a_value_beyond_the_change_nothing_is_learned() -> None:
    for (score,) in office_scores(CutAtChange, "mod", 75_000):
        assert score <= 0.01


# QRM and CRM


@pytest.mark.slow
@pytest.mark.parametrize("method", ["crm", "qrm"])
def test_relabelling_learns_the_office_in_half_the_steps(method: str) -> None:
    for early, late in office_scores(Tabular, method, 25_000, 50_000):
        assert early >= 0.3
        assert 0.65 <= late <= 0.85


def test_ends_that_were_not_met_must_be_learned_too() -> None:
    for (score,) in office_scores(NoTerminalCounterfactuals, "crm", 25_000):
        assert score <= 0.2


@pytest.mark.slow
def test_a_copied_reward_teaches_nothing() -> None:
    for (score,) in office_scores(CopiedReward, "crm", 75_000):
        assert score <= 0.01


@pytest.mark.nightly
@pytest.mark.timeout(300)
def test_crm_reaches_its_published_curve_in_the_craft_world() -> None:
    early, middle, late = craft_scores(Tabular, "crm", 500_000, 750_000, 1_000_000)
    assert early <= 0.2
    assert middle >= 0.9
    assert late >= 0.96


@pytest.mark.nightly
@pytest.mark.timeout(300)
@pytest.mark.parametrize("learner", [ShiftedState, CopiedReward, CutAtChange])
def test_broken_relabelling_learns_nothing_in_the_craft_world(learner: type[Tabular]) -> None:
    assert craft_scores(learner, "crm", 750_000) == [pytest.approx(0.0, abs=0.01)]


@pytest.mark.nightly
@pytest.mark.timeout(300)
def test_the_real_end_for_every_state_is_slower_in_the_craft_world() -> None:
    (score,) = craft_scores(RealEnd, "crm", 750_000)
    assert score < 0.9


@pytest.mark.nightly
@pytest.mark.timeout(300)
def test_a_leaving_modules_own_value_levels_off_in_the_craft_world() -> None:
    middle, late = craft_scores(LeavingModule, "mod", 750_000, 1_000_000)
    assert 0.88 <= middle <= 0.95
    assert 0.88 <= late <= 0.95


# HRM


@pytest.mark.slow
def test_hrm_learns_the_office_within_25_000_steps() -> None:
    for (score,) in office_scores(Tabular, "hrm", 25_000):
        assert 0.5 <= score <= 0.72


@pytest.mark.slow
def test_an_option_must_end_at_a_wrong_transition() -> None:
    for (score,) in office_scores(WrongExitGoesOn, "hrm", 25_000, seeds=(0,)):
        assert score <= 0.01


@pytest.mark.nightly
@pytest.mark.timeout(300)
@pytest.mark.parametrize("seed", [0, 1])
def test_hrm_reaches_its_published_curve_in_the_craft_world(seed: int) -> None:
    early, late = craft_scores(Tabular, "hrm", 250_000, 500_000, seed=seed)
    assert 0.55 <= early <= 0.7
    assert late >= 0.88


@pytest.mark.nightly
@pytest.mark.timeout(300)
def test_options_that_learn_only_while_they_act_learn_nothing_in_the_craft_world() -> None:
    assert craft_scores(ActiveOptionOnly, "hrm", 500_000) == [pytest.approx(0.0, abs=0.01)]


@pytest.mark.nightly
@pytest.mark.timeout(300)
def test_one_discount_per_option_prefers_detours_in_the_craft_world() -> None:
    learner = learned(Tabular, "hrm", CRAFT_TASK_10, 0)
    assert isinstance(learner.method, OptionMethod)
    learner.method._smdp = False
    learner._open = learner.method.open_options(1, 1)
    learner._begin()
    (score,) = learner.scores(CRAFT_M1_OPTIMUM, (500_000,))
    assert score < 0.88
