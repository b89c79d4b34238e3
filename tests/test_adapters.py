"""Anyone's environment as an environment: spaces, wrappers, time-outs, and snapshots that any process can restore."""

from __future__ import annotations

import dataclasses
import re
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import own_environments
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from own_environments import LEFT, LENGTH, RIGHT

from t4nmtd_dist.core.config import EnvironmentConfig
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.environments.batched import BatchedEnv
from t4nmtd_dist.environments.looped_env import LoopedEnv
from t4nmtd_dist.environments.make_env import make_env
from t4nmtd_dist.environments.observations import flattener
from t4nmtd_dist.environments.restore_messages import difference
from t4nmtd_dist.environments.single_env import SingleEnv
from t4nmtd_dist.environments.snapshot_choice import choose_snapshots, with_choice, with_snapshots
from t4nmtd_dist.environments.state_decoding import decode_state
from t4nmtd_dist.environments.state_encoding import CannotRestoreError, encode_state
from t4nmtd_dist.wire.codec import Envelope, decode, encode
from t4nmtd_dist.wire.messages import Release

HERE = str(Path(__file__).parent)
NAMES = ("left", "right", "again")
ONE = np.array([0])


def environment(name: str, **settings: Any) -> EnvironmentConfig:
    return EnvironmentConfig(id=f"own_environments:{name}", horizon=30, path=HERE, **settings)


def env_of(name: str, count: int = 1, **settings: Any) -> BatchedEnv:
    return make_env(environment(name, **settings), count, NAMES)


def course(env: BatchedEnv, actions: list[int]) -> list[list[Any]]:
    """Observations, labels and ends of all copies, step by step."""
    steps = [env.step(np.full(env.count, action)) for action in actions]
    return [[s.observations.tolist(), s.labels.tolist(), s.terminated.tolist(), s.truncated.tolist()] for s in steps]


# Which adapter is chosen


@pytest.mark.parametrize(
    ("name", "adapter", "failed"),
    [
        ("Corridor", "attributes", []),
        ("Mixed", "attributes", []),
        ("timed", "attributes", []),
        ("Named", "own", []),
        ("Forgetful", "attributes", ["own"]),
        ("Opaque", "replay", ["attributes"]),
    ],
)
def test_the_first_adapter_that_restores_exactly_is_chosen(name: str, adapter: str, failed: list[str]) -> None:
    choice = choose_snapshots(environment(name), NAMES)
    assert (choice.adapter, list(choice.failures)) == (adapter, failed)


@pytest.mark.parametrize(
    ("name", "adapter"),
    [("CartPole-v1", "attributes"), ("CliffWalking-v1", "attributes"), ("Acrobot-v1", "attributes")],
)
def test_gymnasiums_own_environments_can_be_restored(name: str, adapter: str) -> None:
    settings = EnvironmentConfig(name, 30, labels="own_environments:nothing_holds", path=HERE)
    assert choose_snapshots(settings, ("left",)).adapter == adapter


def test_mujoco_environments_are_restored_by_their_integration_state(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo may log into the current folder
    settings = EnvironmentConfig("Reacher-v5", 30, labels="own_environments:nothing_holds", path=HERE)
    assert choose_snapshots(settings, ("left",)).adapter == "mujoco"


def test_chance_that_no_seed_reaches_is_refused_with_what_each_adapter_did_wrong() -> None:
    with pytest.raises(EnvError) as raised:
        choose_snapshots(environment("Erratic"), NAMES)
    first, attributes, replay, cause = str(raised.value).splitlines()
    assert "'own_environments:Erratic' cannot be put back into an earlier state" in first
    assert re.search(r"attributes .*: .*another copy, .*(instead of|should)", attributes)
    assert re.search(r"replay.*another copy, .*(instead of|should)", replay)
    assert "draw all of it from self.np_random" in cause


REFUSALS = {
    "Forgetful": ("own", r"get_state\(\) or set_state\(\) leaves out"),
    "Opaque": ("attributes", r"write get_state\(\) and set_state\(\)"),
    "Erratic": ("replay", r"draw all of it from self\.np_random"),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_a_refused_adapter_is_told_with_what_differs_and_what_to_do(name: str) -> None:
    adapter, advice = REFUSALS[name]
    with pytest.raises(EnvError, match=advice) as raised:
        choose_snapshots(environment(name, snapshots=adapter), NAMES)
    told = str(raised.value)
    assert ('environment.snapshots = "replay"' in told) == (adapter != "replay")
    assert re.search(r"after \d+ steps?, |right after restoring, ", told)


@given(
    then=st.lists(st.floats(-9, 9, width=32), min_size=1, max_size=5),
    data=st.data(),
)
def test_a_difference_names_the_entry_and_both_numbers(then: list[float], data: st.DataObject) -> None:
    before = np.array(then, np.float32)
    entry = data.draw(st.integers(0, len(then) - 1))
    now = before.copy()
    now[entry] = np.float32(100.5)
    told = difference("observation", now, before, NAMES)
    assert told is not None
    assert f"entry {entry} of the observation is 100.5 instead of {before[entry]:g}" in told
    assert difference("observation", before, before.copy(), NAMES) is None
    assert difference("observation", np.array([np.nan]), np.array([np.nan]), NAMES) is None


def test_a_difference_names_the_labels_and_the_end() -> None:
    labels = np.array([[True, False, True], [True, True, False]])
    assert (
        difference("labels", labels[0], labels[1], NAMES)
        == "again holds but should not, right should hold but does not"
    )
    assert difference("terminated", True, False, NAMES) == "the episode is terminated but should not be"
    assert difference("truncated", False, True, NAMES) == "the episode is not truncated but should be"
    assert difference("truncated", True, True, NAMES) is None


def test_a_setting_chooses_the_adapter_and_one_that_does_not_fit_is_refused() -> None:
    assert choose_snapshots(environment("Corridor", snapshots="replay"), NAMES).adapter == "replay"
    with pytest.raises(EnvError, match='snapshots = "mujoco" does not fit'):
        env_of("Corridor", snapshots="mujoco", snapshot_bytes=100)


# Snapshots


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Corridor", "Mixed", "timed", "Named", "Opaque"])
@settings(max_examples=15, deadline=None)
@given(before=st.lists(st.integers(0, 1), max_size=12), after=st.lists(st.integers(0, 1), max_size=6))
def test_snapshots_travel_to_other_processes_and_restore_exactly(
    name: str, before: list[int], after: list[int]
) -> None:
    config = with_snapshots(environment(name), NAMES)
    here, there = make_env(config, 1, NAMES), make_env(config, 1, NAMES)
    here.reset(ONE, 5)
    earlier = course(here, before)
    if earlier and (earlier[-1][2][0] or earlier[-1][3][0]):
        return
    (state,) = here.snapshot(ONE)
    (frame,) = decode(encode(Envelope(Release(pid="x", epoch=1), {"state": state}))).arrays.values()
    observations = there.restore(ONE, [frame])
    if earlier:
        assert observations.tolist() == earlier[-1][0]
    assert course(there, after) == course(here, after)


def test_snapshots_of_a_run_are_all_alike() -> None:
    for name in ("Corridor", "Named", "Opaque"):
        env = env_of(name, 3)
        env.reset(np.arange(3), 0)
        fresh = env.snapshot(np.arange(3))
        course(env, [LEFT, RIGHT, RIGHT, RIGHT])
        kinds = {(state.dtype, state.shape) for state in [*fresh, *env.snapshot(np.arange(3))]}
        assert len(kinds) == 1


def test_equal_states_give_equal_snapshots_however_they_came_about() -> None:
    env = env_of("Corridor")
    env.reset(ONE, 1)
    course(env, [LEFT, RIGHT])
    (first,) = env.snapshot(ONE)
    env.reset(ONE, 2)
    course(env, [LEFT, RIGHT])
    (second,) = env.snapshot(ONE)
    assert first.tolist() == second.tolist()


def test_every_attempt_from_a_start_throws_new_dice() -> None:
    for snapshots in ("attributes", "replay"):
        env = env_of("Corridor", options={"slip": 0.5}, snapshots=snapshots)
        env.reset(ONE, 0)
        course(env, [LEFT])
        (start,) = env.snapshot(ONE)
        courses = []
        for _ in range(8):
            env.restore(ONE, [start])
            courses.append(str(course(env, [RIGHT] * 5)))
        assert len(set(courses)) > 2, snapshots


def test_a_replay_repeats_the_dice_of_all_attempts_before() -> None:
    settings: dict[str, Any] = {"options": {"slip": 0.5}, "snapshots": "replay"}
    env, other = env_of("Corridor", **settings), env_of("Corridor", **settings)
    env.reset(ONE, 0)
    (state,) = env.snapshot(ONE)
    for number in range(6):
        env.restore(ONE, [state])
        observations = env.step(np.array([number % 2])).observations
        (state,) = env.snapshot(ONE)
        assert other.restore(ONE, [state]).tolist() == observations.tolist()


def test_replayed_steps_are_counted() -> None:
    env = env_of("Opaque")
    env.reset(ONE, 0)
    course(env, [LEFT] * 4)
    (state,) = env.snapshot(ONE)
    before = env.replayed
    env.restore(ONE, [state])
    assert env.replayed - before == 4


def test_an_episode_that_can_no_longer_be_replayed_is_cut() -> None:
    env = make_env(dataclasses.replace(environment("Opaque"), horizon=5, snapshots="replay"), 1, NAMES)
    env.reset(ONE, 0)
    assert [step[3] for step in course(env, [LEFT] * 5)] == [[False]] * 4 + [[True]]


def test_a_snapshot_of_something_else_is_refused() -> None:
    (state,) = env_of("Mixed").snapshot(ONE)
    env = env_of("Corridor")
    for wrong in (state, np.zeros(3), np.zeros(8, np.uint8), np.full(40, 255, np.uint8)):
        with pytest.raises(EnvError, match="no snapshot of <Corridor"):
            env.restore(ONE, [wrong])


def test_a_snapshot_that_does_not_fit_says_what_to_do() -> None:
    env = env_of("Corridor", snapshots="attributes", snapshot_bytes=8)
    env.reset(ONE, 0)
    with pytest.raises(EnvError, match=r"room for 8: set environment\.snapshot_bytes"):
        env.snapshot(ONE)


# What a callable returns is kept as it is


def test_wrappers_and_their_counters_are_part_of_the_world() -> None:
    env = env_of("timed", options={"steps": 4})
    env.reset(ONE, 0)
    course(env, [LEFT] * 3)
    (late,) = env.snapshot(ONE)
    env.reset(ONE)
    assert [step[3] for step in course(env, [LEFT] * 4)] == [[False]] * 3 + [[True]]
    env.restore(ONE, [late])
    assert course(env, [LEFT])[0][2:] == [[False], [True]], "a time-out is no terminal"


def test_a_registered_environment_loses_gymnasiums_time_limit_only() -> None:
    settings = EnvironmentConfig("MountainCar-v0", 300, labels="own_environments:nothing_holds", path=HERE)
    env = make_env(settings, 1, ("left",))
    env.reset(ONE, 0)
    assert not any(env.step(np.array([1])).truncated[0] for _ in range(250))


# Opening and labels


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"id": "own_environments:Corrridor"}, "own_environments has no 'Corrridor'"),
        ({"id": "no_such_module:Corridor"}, f"no module 'no_such_module' in {HERE}, nor among what is installed"),
        ({"id": "NoSuch-v0"}, "'NoSuch-v0'"),
        ({"id": "own_environments:failing"}, "RuntimeError: no licence"),
        ({"id": "own_environments:not_an_environment"}, "made object; expected a gymnasium.Env"),
        ({"id": "own_environments:Pairs"}, r"observation space Tuple\(.* is not supported"),
        ({"options": {"colour": 1}}, "refused its options"),
        ({"labels": "own_environments"}, "expected module:function"),
        ({"labels": "own_environments:missing"}, "has no function 'missing'"),
        ({"path": "/nowhere", "labels": "nowhere_at_all:f"}, "no folder on this machine"),
    ],
)
def test_what_cannot_be_opened_is_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(EnvError, match=message):
        make_env(dataclasses.replace(environment("Corridor"), **changes), 1, NAMES)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("undeclared", "own_environments:undeclared reported 'middle', which is not declared; .* left, right, again"),
        ("one_name", "own_environments:one_name gave 'left'; expected a set of names"),
        ("nothing", "own_environments:nothing gave None; expected a set of names"),
        ("raising", "labelling function own_environments:raising raised KeyError: 'speed'"),
    ],
)
def test_a_labelling_function_that_does_not_do_its_work_is_named(function: str, message: str) -> None:
    env = env_of("Corridor", labels=f"own_environments:{function}", snapshots="attributes", snapshot_bytes=400)
    env.reset(ONE, 0)
    with pytest.raises(EnvError, match=message):
        env.step(np.array([LEFT]))


def test_without_a_function_the_environment_must_report_labels() -> None:
    env = make_env(EnvironmentConfig("CartPole-v1", 10, snapshots="attributes", snapshot_bytes=400), 1, NAMES)
    env.reset(ONE, 0)
    with pytest.raises(EnvError, match="names no labelling function"):
        env.step(np.array([LEFT]))


def test_a_labelling_function_sees_the_observation_as_it_was() -> None:
    env = env_of("Corridor", labels="own_environments:ends")
    env.reset(ONE, 0)
    labels = [step[1][0] for step in course(env, [LEFT] * 3)]
    assert labels == [[False] * 3, [False] * 3, [True, False, False]]


def test_observations_that_are_not_finite_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    env = env_of("Mixed")
    assert isinstance(env, LoopedEnv)
    env.reset(ONE, 0)
    broken = {"picture": np.full((2, LENGTH), np.nan, np.float32), "last": 0}
    monkeypatch.setattr(own_environments.Mixed, "observe", lambda _: broken)
    with pytest.raises(EnvError, match=r"observation of step\(\) holds NaN or infinity"):
        env.step(np.array([LEFT]))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_first_observation_that_is_not_finite_is_refused(bad: float, monkeypatch: pytest.MonkeyPatch) -> None:
    env = env_of("Offset")
    monkeypatch.setattr(own_environments.Offset, "observe", lambda _: np.array([bad], np.float32))
    with pytest.raises(EnvError, match=r"observation of reset\(\) holds NaN or infinity"):
        env.reset(ONE, 0)


def test_an_observation_of_a_restored_state_that_is_not_finite_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    class Kept(own_environments.Offset):
        propositions = NAMES

        def get_state(self) -> Any:
            return np.array([self.place])

        def set_state(self, state: Any) -> Any:
            return np.array([np.nan], np.float32)

    monkeypatch.setattr(own_environments, "Kept", Kept, raising=False)
    env = env_of("Kept", snapshots="own")
    env.reset(ONE, 0)
    with pytest.raises(EnvError, match="observation after restoring a state holds NaN or infinity"):
        env.restore(ONE, env.snapshot(ONE))


@pytest.mark.parametrize("state", [np.zeros((2, 3)), np.array(1.0), (1, 2)], ids=["matrix", "number", "tuple"])
def test_a_snapshot_that_is_no_flat_array_is_refused(state: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_environments.Named, "propositions", NAMES, raising=False)
    env = env_of("Named", snapshots="own")
    env.reset(ONE, 0)
    monkeypatch.setattr(own_environments.Named, "get_state", lambda _: state)
    with pytest.raises(EnvError, match=r"get_state\(\).*expected a flat NumPy array"):
        env.snapshot(ONE)


# Observations


def test_observations_are_flattened() -> None:
    box, one_of = spaces.Box(0, 255, (2, 3), np.uint8), spaces.Discrete(3, start=-1)
    assert flattener(box).flatten(np.arange(6, dtype=np.uint8).reshape(2, 3)).tolist() == [0, 1, 2, 3, 4, 5]
    assert flattener(one_of).flatten(1).tolist() == [0, 0, 1]
    both = flattener(spaces.Dict({"b": box, "a": one_of}))
    flat = both.flatten({"a": -1, "b": np.ones((2, 3))})
    assert both.size == flat.size == 9
    assert flat.dtype == np.float32
    assert sorted(flat.tolist()) == [0, 0] + [1] * 7
    with pytest.raises(EnvError, match=r"not in -1\.\.1"):
        flattener(one_of).flatten(2)


@pytest.mark.parametrize(
    "space", [spaces.MultiBinary(3), spaces.Dict({"inner": spaces.Dict({"a": spaces.Discrete(2)})}), spaces.Text(3)]
)
def test_other_observations_are_refused_by_name(space: Any) -> None:
    with pytest.raises(EnvError, match="is not supported; expected Box, Discrete, MultiDiscrete, or a flat Dict"):
        flattener(space)


@pytest.mark.parametrize("space", [spaces.Discrete(2, start=1), spaces.MultiDiscrete([2, 2])])
def test_other_actions_are_refused_by_name(space: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    made = own_environments.Corridor()
    made.action_space = space
    monkeypatch.setattr(own_environments, "Corridor", lambda: made)
    with pytest.raises(EnvError, match=r"action space .* is not supported"):
        SingleEnv(environment("Corridor"), NAMES)


# States of objects as bytes

PLAIN = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | st.binary()
TREES = st.recursive(
    PLAIN,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.tuples(inner, inner)
        | st.dictionaries(st.text() | st.integers() | st.tuples(st.integers(), st.text()), inner, max_size=4)
        | st.frozensets(st.integers() | st.text(), max_size=4)
        | st.sets(st.tuples(st.integers(), st.booleans()), max_size=4)
    ),
    max_leaves=12,
)


@given(value=TREES, other=TREES)
@pytest.mark.slow
def test_plain_data_comes_back_whatever_was_there(value: Any, other: Any) -> None:
    packed = encode_state(value)
    fresh = decode_state(packed, other)
    assert fresh == value
    assert encode_state(fresh) == packed


@dataclasses.dataclass
class Thing:
    place: Any
    rng: Any = None
    friend: Any = None


def test_objects_are_restored_where_they_are_so_that_others_see_it() -> None:
    grid = np.arange(6.0).reshape(2, 3)
    rng, legacy = np.random.default_rng(3), np.random.RandomState(3)
    thing = Thing(grid, rng, [deque([1, 2]), legacy, np.float64(0.5), 2**70])
    thing.self_reference = thing  # type: ignore[attr-defined]
    alias, packed = grid, encode_state(thing)
    drawn = rng.random(3).tolist(), legacy.rand(3).tolist()
    grid += 1
    thing.friend[0].append(9)
    thing.later = "an attribute that was not there"  # type: ignore[attr-defined]
    assert decode_state(packed, thing) is thing
    assert alias.tolist() == np.arange(6.0).reshape(2, 3).tolist()
    assert thing.place is alias
    assert thing.friend[0] == deque([1, 2])
    assert isinstance(thing.friend[2], np.float64)
    assert thing.friend[3] == 2**70
    assert (rng.random(3).tolist(), legacy.rand(3).tolist()) == drawn
    assert not hasattr(thing, "later")


def test_objects_that_are_gone_cannot_be_made_again() -> None:
    with pytest.raises(CannotRestoreError, match="NoneType"):
        decode_state(encode_state(Thing(1)), None)


def test_the_room_that_was_chosen_is_kept() -> None:
    config = environment("Corridor", snapshot_bytes=4000)
    assert with_choice(config, choose_snapshots(config, NAMES)).snapshot_bytes == 4000
