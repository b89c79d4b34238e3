"""How a policy acts: greedily or by sampling, reproducibly, on one thread."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from small_sac import small_sac, small_sac_task
from small_tasks import CARRYING_2, START, small_learner, small_task

from t4nmtd_dist.agents.sac.fast_cpu import forward
from t4nmtd_dist.core.errors import PolicyError
from t4nmtd_dist.policy.export import POLICY_FILE, export_policy
from t4nmtd_dist.policy.global_policy import GlobalPolicy
from t4nmtd_dist.policy.loading import load

PROBABILITIES = (0.6, 0.3, 0.1, 0.0, 0.0, 0.0)
LAKE = np.zeros(83, np.float32)


def lottery() -> dict[str, NDArray[np.float32]]:
    """An actor that draws the lake's six actions with fixed probabilities, whatever it sees."""
    width = 83 + small_task().dfa.states
    logits = np.log(np.maximum(np.array(PROBABILITIES, np.float32), 1e-30))
    return {
        "actor.0.weight": np.zeros((16, width), np.float32),
        "actor.0.bias": np.zeros(16, np.float32),
        "actor.2.weight": np.zeros((6, 16), np.float32),
        "actor.2.bias": logits.astype(np.float32),
    }


def lake_policy(**options: Any) -> GlobalPolicy:
    task = small_task()
    actors = {pid: lottery() for pid in task.decomposition.pids}
    return GlobalPolicy(task, [(START, "p2", 1.0)], actors, **options)


def car_policy(**options: Any) -> GlobalPolicy:
    task = small_sac_task()
    actors = {pid: small_sac(pid).weights() for pid in ("g1", "g2")}
    return GlobalPolicy(task, [], actors, **options)


def car_observation() -> NDArray[np.float32]:
    return small_sac("g1").rollout.observations[0]


def acted(policy: GlobalPolicy, observation: NDArray[np.float32], count: int, **options: Any) -> list[Any]:
    """Actions of so many calls, all in the DFA's first state."""
    return [np.asarray(policy.act(observation, (), **options)).tolist() for _ in range(count)]


# Sampling


def test_sampled_actions_come_with_the_probabilities_of_the_categorical() -> None:
    counts = np.bincount(acted(lake_policy(), LAKE, 4000, actions="sampled", rng=np.random.default_rng(1)), minlength=6)
    assert counts / 4000 == pytest.approx(PROBABILITIES, abs=0.04)


def test_greedy_is_the_default_and_the_most_likely_action() -> None:
    assert set(acted(lake_policy(), LAKE, 20)) == {0}
    assert set(acted(lake_policy(mode="sampled"), LAKE, 20, actions="greedy")) == {0}


def test_a_gaussian_is_sampled_around_its_mode_within_the_bounds_of_the_actions() -> None:
    policy, observation = car_policy(), car_observation()
    mode = np.array(acted(policy, observation, 1)[0])
    drawn = np.array(acted(policy, observation, 2000, actions="sampled", rng=np.random.default_rng(0)))
    assert acted(policy, observation, 2) == [mode.tolist()] * 2
    assert drawn.std(axis=0).min() > 0.1
    assert np.median(drawn, axis=0) == pytest.approx(mode, abs=0.1)
    assert (np.abs(drawn) <= 1.0).all()


@pytest.mark.parametrize(("make", "observe"), [(lake_policy, lambda: LAKE), (car_policy, car_observation)])
def test_sampling_is_reproducible_from_a_seed(make: Any, observe: Any) -> None:
    policy, observation = make(mode="sampled", seed=5), observe()
    first = acted(policy, observation, 30)
    policy.reset()
    assert acted(policy, observation, 30) != first, "a reset without a seed draws on"
    policy.reset(seed=5)
    assert acted(policy, observation, 30) == first
    assert acted(make(mode="sampled", seed=5), observation, 30) == first
    assert acted(make(mode="sampled", seed=6), observation, 30) != first
    rng = np.random.default_rng(5)
    assert acted(make(), observation, 30, actions="sampled", rng=rng) == first


def test_an_unknown_way_of_acting_is_refused() -> None:
    with pytest.raises(PolicyError, match=r"'best'.*greedy.*sampled"):
        lake_policy().act(LAKE, (), actions="best")  # type: ignore[arg-type]
    with pytest.raises(PolicyError, match=r"'random'.*greedy.*sampled"):
        lake_policy(mode="random")


# What an export remembers


def exported(folder: Path, **options: Any) -> Path:
    weights = {pid: small_learner(pid).weights() for pid in ("p1", "p2")}
    export_policy(folder / "policy", small_task(), [(CARRYING_2, "p1", 1.0)], weights, {}, **options)
    return folder


def test_an_export_remembers_how_its_policy_acts(tmp_path: Path) -> None:
    assert load(exported(tmp_path, mode="sampled")).mode == "sampled"
    assert len(set(acted(load(tmp_path, seed=1), LAKE, 50))) > 1
    assert acted(load(tmp_path, seed=1), LAKE, 50) == acted(load(tmp_path, seed=1), LAKE, 50)
    assert load(exported(tmp_path)).mode == "greedy"
    assert len(set(acted(load(tmp_path), LAKE, 50))) == 1


def test_an_export_that_does_not_say_is_greedy_and_one_that_says_nonsense_is_refused(tmp_path: Path) -> None:
    path = exported(tmp_path) / "policy" / POLICY_FILE
    data = json.loads(path.read_text(encoding="utf-8"))
    del data["actions"]
    path.write_text(json.dumps(data), encoding="utf-8")
    assert load(tmp_path).mode == "greedy"
    path.write_text(json.dumps({**data, "actions": "best"}), encoding="utf-8")
    with pytest.raises(PolicyError, match="'best'"):
        load(tmp_path)


# Threads


@pytest.fixture
def three_threads() -> Iterator[None]:
    """What a user may have set for the rest of the program."""
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("three_threads")
def test_a_categorical_acts_on_one_thread_and_the_users_setting_survives() -> None:
    policy, seen = lake_policy(), list[int]()
    hook = torch.nn.modules.module.register_module_forward_pre_hook(lambda *_: seen.append(torch.get_num_threads()))
    try:
        policy.act(LAKE, ())
    finally:
        hook.remove()
    assert set(seen) == {1}
    assert torch.get_num_threads() == 3


@pytest.mark.usefixtures("three_threads")
def test_a_gaussian_acts_on_one_thread_and_the_users_setting_survives(monkeypatch: pytest.MonkeyPatch) -> None:
    policy, seen, multiply_add = car_policy(), list[int](), forward.multiply_add

    def watched(*arguments: Any) -> None:
        seen.append(torch.get_num_threads())
        multiply_add(*arguments)

    monkeypatch.setattr(forward, "multiply_add", watched)
    policy.act(car_observation(), ())
    assert set(seen) == {1}
    assert torch.get_num_threads() == 3


@pytest.mark.usefixtures("three_threads")
def test_the_users_threads_survive_an_error() -> None:
    policy = lake_policy()
    with pytest.raises(RuntimeError):
        policy.actions(np.zeros((1, 5), np.float32), np.array([START], np.int32))
    assert torch.get_num_threads() == 3
