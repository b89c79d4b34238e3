"""Exported policies: the same actions as the live actors, and a clear word about any damage."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file
from small_tasks import ACCEPTING, CARRYING_2, ERROR, PICK, START, TO_GOAL, TO_PASSENGER_2, small_learner, small_task

from t4nmtd_dist.agents.common.product_states import product_states
from t4nmtd_dist.agents.ppo.agent import PPOLearner
from t4nmtd_dist.core.errors import PolicyError
from t4nmtd_dist.policy.export import ACTORS_FILE, POLICY_FILE, export_policy
from t4nmtd_dist.policy.global_policy import GlobalPolicy
from t4nmtd_dist.policy.loading import load

Q_TABLE = [(START, "p2", 5.0), (START, "p1", 1.0), (CARRYING_2, "g", 9.0), (CARRYING_2, "p1", 2.0)]
PIDS = ("g", "p1", "p2", "p3")


@pytest.fixture(scope="module")
def learners() -> dict[str, PPOLearner]:
    made = {pid: small_learner(pid) for pid in PIDS}
    for learner in made.values():
        with torch.no_grad():
            for parameter in learner.network.actor.parameters():
                parameter.mul_(100.0)  # the initial actors hardly prefer any action
    return made


@pytest.fixture(scope="module")
def exported(learners: dict[str, PPOLearner], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("run") / "policy"
    weights = {pid: learner.weights() for pid, learner in learners.items()}
    export_policy(folder, small_task(), Q_TABLE, weights, {"seed": 0})
    return folder


def copy_of(exported: Path, folder: Path) -> Path:
    for name in (POLICY_FILE, ACTORS_FILE):
        (folder / name).write_bytes((exported / name).read_bytes())
    return folder


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 1000), q=st.lists(st.sampled_from([0, 1, 2, 4]), min_size=1, max_size=8))
def test_a_loaded_policy_acts_as_the_live_actors(
    learners: dict[str, PPOLearner], exported: Path, seed: int, q: list[int]
) -> None:
    policy, states = load(exported), np.array(q, np.int32)
    size = learners["g"].rollout.observations.shape[1]
    observations = np.random.default_rng(seed).uniform(-1, 1, (len(q), size)).astype(np.float32)
    expected = []
    for row, state in enumerate(q):
        live = learners[policy.subtask_of[state]].network.actor
        with torch.no_grad():
            expected.append(int(live(torch.from_numpy(product_states(observations[[row]], states[[row]], 6))).argmax()))
    assert policy.actions(observations, states)[0].tolist() == expected


def test_the_greedy_subtask_of_every_state_acts(exported: Path) -> None:
    policy = load(exported)
    assert policy.subtask_of[START] == "p2"
    assert policy.subtask_of[CARRYING_2] == "g"
    assert set(policy.subtask_of) == {0, 1, 2, 4}
    _, known = policy.actions(np.zeros((2, 83), np.float32), np.array([ACCEPTING, ERROR], np.int32))
    assert known.tolist() == [False, False]


def test_a_subtask_without_an_actor_is_not_chosen(learners: dict[str, PPOLearner]) -> None:
    task = small_task()
    policy = GlobalPolicy(task, Q_TABLE, {"p1": learners["p1"].weights()})
    assert policy.subtask_of == {START: "p1", CARRYING_2: "p1", 4: "p1"}


def test_a_run_directory_is_as_good_as_the_policy_in_it(exported: Path) -> None:
    assert load(exported.parent).dfa == load(str(exported)).dfa == small_task().dfa


def test_acting_follows_the_automaton_and_skips_the_labels_of_the_reset(exported: Path) -> None:
    """Trap: the labels of the reset state are read."""
    policy = load(exported)
    policy.reset()
    observation = np.zeros(83, np.float32)
    policy.act(observation, {"p2"})
    assert policy.state == START
    policy.act(observation, {"p2"})
    assert policy.state == CARRYING_2
    policy.reset()
    policy.act(observation, {"p1", "p2", "p3"})
    assert policy.state == START


def test_acting_after_the_end_says_to_begin_an_episode(exported: Path) -> None:
    policy, observation = load(exported), np.zeros(83, np.float32)
    for labels in (set(), {"p2"}):
        policy.act(observation, labels)
    with pytest.raises(PolicyError, match=r"accepting.*reset\(\)"):
        policy.act(observation, {"p2", "g"})


def test_an_error_state_is_called_that_and_told_beforehand(exported: Path) -> None:
    policy, observation = load(exported), np.zeros(83, np.float32)
    policy.act(observation, set())
    policy.act(observation, {"p2"})
    assert policy.state == CARRYING_2
    assert policy.failed({"p1", "p2", "p3"})
    assert not policy.failed({"p2"})
    assert not policy.failed({"p2", "g"})
    assert policy.state == CARRYING_2  # asking changes nothing
    with pytest.raises(PolicyError, match=r"an error state; call reset\(\)"):
        policy.act(observation, {"p1", "p2", "p3"})


@pytest.mark.parametrize(
    "observation", [{"place": np.zeros(83)}, "north", [[1.0], [2.0, 3.0]]], ids=["dict", "text", "ragged"]
)
def test_observations_that_are_no_numbers_are_refused_with_advice(observation: Any, exported: Path) -> None:
    with pytest.raises(
        PolicyError, match=rf"type {type(observation).__name__} .*environments\.observations\.flattener"
    ):
        load(exported).act(observation, set())


def test_a_whole_episode_in_the_real_lake_ends_in_acceptance(exported: Path) -> None:
    """The labels as the environment gives them drive the policy's automaton."""
    policy, env = load(exported), gym.make("envs:t4nmtd/FrozenLake-v0", goals=1)
    observation, info = env.reset(seed=0)
    for action in (*TO_PASSENGER_2, PICK, *TO_GOAL):
        policy.act(observation, info["labels"])
        observation, _, _, _, info = env.step(action)
    assert policy.state == CARRYING_2
    with pytest.raises(PolicyError, match="accepting"):
        policy.act(observation, info["labels"])
    assert policy.state == ACCEPTING


@pytest.mark.parametrize("hidden", ["[1]", "[8]", "[8,8,8,8,8,8,8]"])
def test_any_number_of_layers_comes_back(hidden: str, tmp_path: Path) -> None:
    learner = small_learner("p2", f"learner.hidden={hidden}")
    task = small_task(f"learner.hidden={hidden}")
    export_policy(tmp_path / "policy", task, Q_TABLE, {"p2": learner.weights()}, {})
    observations, q = np.ones((1, 83), np.float32), np.zeros(1, np.int32)
    with torch.no_grad():
        expected = int(learner.network.actor(torch.from_numpy(product_states(observations, q, 6))).argmax())
    assert load(tmp_path / "policy").actions(observations, q)[0].tolist() == [expected]


def test_an_export_replaces_the_one_before_and_leaves_nothing_half_written(exported: Path, tmp_path: Path) -> None:
    folder = tmp_path / "policy"
    weights = {pid: small_learner(pid).weights() for pid in ("p1", "p2")}
    for table in ([(START, "p1", 1.0)], [(START, "p2", 1.0)]):
        export_policy(folder, small_task(), table, weights, {})
    assert load(folder).subtask_of[START] == "p2"
    assert [path.name for path in tmp_path.iterdir()] == ["policy"]


def test_a_missing_policy_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match="no policy in"):
        load(tmp_path)
    with pytest.raises(PolicyError, match="no policy in"):
        load(tmp_path / "absent")


def edited(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        data = json.loads((folder / POLICY_FILE).read_text())
        (folder / POLICY_FILE).write_text(json.dumps(change(data)))

    return damage


def reshaped(change: Callable[[dict[str, NDArray[Any]]], Any]) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        arrays = {name: array.copy() for name, array in load_file(folder / ACTORS_FILE).items()}
        save_file(change(arrays), folder / ACTORS_FILE)

    return damage


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "another format": edited(lambda data: {**data, "format": 99}),
    "no format": edited(lambda data: {key: data[key] for key in data if key != "format"}),
    "not an object": edited(lambda data: []),
    "not JSON": lambda folder: (folder / POLICY_FILE).write_text("{"),
    "not text": lambda folder: (folder / POLICY_FILE).write_bytes(b"\xff\xfe\x00"),
    "no automaton": edited(lambda data: {key: data[key] for key in data if key != "dfa"}),
    "an automaton of another kind": edited(lambda data: {**data, "dfa": []}),
    "an automaton with a gap": edited(lambda data: {**data, "dfa": {**data["dfa"], "edges": data["dfa"]["edges"][1:]}}),
    "sub-tasks of another kind": edited(lambda data: {**data, "decomposition": {"p1": 3}}),
    "a task with an unknown key": edited(lambda data: {**data, "task": {**data["task"], "x": 1}}),
    "a table of another kind": edited(lambda data: {**data, "q_table": [[1, 2]]}),
    "potentials of another kind": edited(lambda data: {**data, "rho": "x"}),
    "too few potentials": edited(lambda data: {**data, "rho": [1.0]}),
    "no actors": lambda folder: (folder / ACTORS_FILE).unlink(),
    "actors cut short": lambda folder: (folder / ACTORS_FILE).write_bytes((folder / ACTORS_FILE).read_bytes()[:200]),
    "actors empty": lambda folder: (folder / ACTORS_FILE).write_bytes(b""),
    "an actor lacks a layer": reshaped(lambda a: {k: v for k, v in a.items() if k != "p2/actor.0.weight"}),
    "an actor without matrices": reshaped(lambda a: {k: v for k, v in a.items() if "p2" not in k or "bias" in k}),
    "an actor of vectors": reshaped(lambda a: {k: v.reshape(-1) for k, v in a.items()}),
    "an actor of other names": reshaped(lambda a: {k.replace("actor.0", "actor.first"): v for k, v in a.items()}),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES.keys())
def test_damage_is_a_policy_error(damage: Callable[[Path], Any], exported: Path, tmp_path: Path) -> None:
    folder = copy_of(exported, tmp_path)
    load(folder)
    damage(folder)
    with pytest.raises(PolicyError):
        load(folder)
