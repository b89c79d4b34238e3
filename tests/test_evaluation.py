"""Evaluation of policies written by hand, in the real lake: what counts as success, and for how long."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from small_tasks import (
    ACCEPTING,
    CARRYING_2,
    DOWN,
    LEFT,
    PICK,
    RIGHT,
    START,
    TO_GOAL,
    TO_PASSENGER_2,
    own_task,
    small_task,
)

from t4nmtd_dist.core.errors import PolicyError
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.policy import evaluation
from t4nmtd_dist.policy.evaluation import Evaluator
from t4nmtd_dist.policy.global_policy import GlobalPolicy
from t4nmtd_dist.tasks import load_task

CELLS, ACTIONS, OBSERVATION = 64, 6, 83
SOLUTION = len(TO_PASSENGER_2) + 1 + len(TO_GOAL)
TABLE = [(START, "p2", 1.0), (CARRYING_2, "g", 1.0)]

Weights = dict[str, NDArray[np.float32]]


def actor(task: CompiledTask, action_at: dict[int, int], otherwise: int) -> Weights:
    """An actor that takes a given action in given cells, and another one elsewhere."""
    matrix = np.zeros((ACTIONS, OBSERVATION + task.dfa.states), np.float32)
    for cell, action in action_at.items():
        matrix[action, cell] = 2.0
    bias = np.eye(ACTIONS, dtype=np.float32)[otherwise]
    passed_on = {"actor.2.weight": np.eye(ACTIONS, dtype=np.float32), "actor.2.bias": np.zeros(ACTIONS, np.float32)}
    return {"actor.0.weight": matrix, "actor.0.bias": bias, **passed_on}


def task_of_actors(*flags: str) -> CompiledTask:
    return small_task(f"learner.hidden=[{ACTIONS}]", *flags)


def policy_of(task: CompiledTask, actors: dict[str, Weights]) -> GlobalPolicy:
    return GlobalPolicy(task, TABLE, actors)


def expert(*flags: str) -> GlobalPolicy:
    """Fetches passenger 2 and carries it to the goal."""
    task = task_of_actors(*flags)
    fetch = {0: RIGHT, 1: RIGHT, 2: RIGHT, 3: DOWN, 11: DOWN, 19: DOWN, 27: PICK}
    carry = {27: DOWN, 35: DOWN, 43: RIGHT, 44: RIGHT}
    return policy_of(task, {"p2": actor(task, fetch, LEFT), "g": actor(task, carry, LEFT)})


def always(action: int, *flags: str) -> GlobalPolicy:
    task = task_of_actors(*flags)
    return policy_of(task, {pid: actor(task, {}, action) for pid in task.decomposition.pids})


def test_a_policy_that_solves_the_task_is_seen_to_do_so() -> None:
    policy = expert()
    result = Evaluator(policy, 3, seed=0).run(policy)
    assert result.success.all()
    assert result.success_rate == 1.0
    assert result.lengths.tolist() == [SOLUTION] * 3
    assert result.returns == pytest.approx(policy.rho[ACCEPTING] - policy.rho[START])
    assert result.dfa_path == [START, CARRYING_2, ACCEPTING]


def test_every_episode_has_a_fresh_step_counter() -> None:
    """Trap: the evaluation's step counter not reset between episodes."""
    policy = expert(f"environment.horizon={SOLUTION}")
    evaluator = Evaluator(policy, 2, seed=0)
    for _ in range(3):
        result = evaluator.run(policy)
        assert result.success.all()
        assert result.lengths.tolist() == [SOLUTION] * 2
        assert result.dfa_path == [START, CARRYING_2, ACCEPTING]


def test_the_horizon_is_respected() -> None:
    policy = expert(f"environment.horizon={SOLUTION - 1}")
    result = Evaluator(policy, 2, seed=0).run(policy)
    assert not result.success.any()
    assert result.lengths.tolist() == [SOLUTION - 1] * 2


def test_an_episode_goes_on_to_the_horizon_if_nothing_happens() -> None:
    policy = always(LEFT, "environment.horizon=17")
    result = Evaluator(policy, 2, seed=0).run(policy)
    assert result.success_rate == 0.0
    assert result.lengths.tolist() == [17, 17]
    assert result.returns.tolist() == [0.0, 0.0]
    assert result.dfa_path == [START]


def test_an_episode_ends_in_a_hole() -> None:
    policy = always(DOWN)
    result = Evaluator(policy, 2, seed=0).run(policy)
    assert (result.success_rate, result.lengths.tolist()) == (0.0, [2, 2])


def test_without_an_actor_an_episode_is_over_before_it_begins() -> None:
    task = task_of_actors()
    result = Evaluator(expert(), 2, seed=0).run(policy_of(task, {}))
    assert (result.success_rate, result.lengths.tolist()) == (0.0, [0, 0])


def test_an_error_ends_an_episode_and_is_not_in_its_return(tmp_path: Path) -> None:
    text = """
name = "own"
formula = "F(p1) & G(!p2)"
propositions = ["p1", "p2"]
acceptance = "first"
[environment]
id = "envs:t4nmtd/FrozenLake-v0"
horizon = 50
[learner]
hidden = [6]
"""
    task = compile_task(load_task(str(own_task(tmp_path, text)), flags=["learner.algorithm=ppo"]))
    fetch = {0: RIGHT, 1: RIGHT, 2: RIGHT, 3: DOWN, 11: DOWN, 19: DOWN, 27: PICK}
    policy = GlobalPolicy(task, [], {"p1": actor(task, fetch, LEFT)})
    result = Evaluator(policy, 2, seed=0).run(policy)
    assert not result.success.any()
    assert result.lengths.tolist() == [len(TO_PASSENGER_2) + 1] * 2
    assert result.dfa_path[-1] in task.dfa.error
    assert result.returns.tolist() == [0.0, 0.0]


# Perturbed starts


def test_perturbed_starts_that_ended_the_episode_are_drawn_again() -> None:
    policy = always(PICK, "environment.horizon=5")
    result = Evaluator(policy, 64, seed=0).run(policy, perturb=20)
    assert result.redrawn > 0
    assert result.lengths.tolist() == [5] * 64, "a start that is over already would end at once"


def test_the_last_round_of_random_actions_counts_as_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluation, "PERTURBATION_ROUNDS", 1)
    policy = expert()
    assert Evaluator(policy, 4, seed=0).run(policy, perturb=0).lengths.tolist() == [SOLUTION] * 4


def test_perturbed_starts_differ_and_are_those_of_the_seed() -> None:
    policy = expert()
    first = Evaluator(policy, 32, seed=1).run(policy, perturb=6)
    again = Evaluator(policy, 32, seed=1).run(policy, perturb=6)
    other = Evaluator(policy, 32, seed=2).run(policy, perturb=6)
    assert first.lengths.tolist() == again.lengths.tolist() != other.lengths.tolist()
    assert len(set(first.lengths.tolist())) > 1
    assert SOLUTION in first.lengths, "k = 0 is among the draws"


def test_a_perturbed_evaluation_leaves_nothing_behind_for_the_next() -> None:
    policy = expert()
    evaluator = Evaluator(policy, 4, seed=0)
    evaluator.run(policy, perturb=10)
    assert evaluator.run(policy).lengths.tolist() == [SOLUTION] * 4


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), perturb=st.integers(0, 20))
def test_the_validation_return_telescopes(seed: int, perturb: int) -> None:
    task = task_of_actors("environment.horizon=40")
    rng = np.random.default_rng(seed)
    actions = [dict(enumerate(rng.integers(ACTIONS, size=CELLS).tolist())) for _ in range(4)]
    actors = {pid: actor(task, at, LEFT) for pid, at in zip(task.decomposition.pids, actions, strict=True)}
    policy = policy_of(task, actors)
    result = Evaluator(policy, 1, seed=seed).run(policy, perturb=perturb)
    first, last = result.dfa_path[0], result.dfa_path[-1]
    assert result.returns[0] == pytest.approx(policy.rho[last] - policy.rho[first])
    assert result.success[0] == (last == ACCEPTING)
    assert result.lengths[0] <= 40


def test_a_policy_that_learned_from_other_observations_is_refused() -> None:
    task, good = task_of_actors(), expert()
    older = actor(task, {}, LEFT)
    older["actor.0.weight"] = older["actor.0.weight"][:, 1:]
    with pytest.raises(PolicyError, match=f"observations of {OBSERVATION - 1} numbers.*have {OBSERVATION}: train"):
        Evaluator(good, 2, seed=0).run(policy_of(task, {"p2": older, "g": older}))
