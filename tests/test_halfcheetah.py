"""HalfCheetah: equal to gymnasium's physics, markers, snapshots with the warm start, bad input."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from envs.halfcheetah import HalfCheetahEnv
from envs.halfcheetah_rules import load_model
from envs.protocol import SnapshotEnv
from t4nmtd_dist.wire.codec import Envelope, decode, encode
from t4nmtd_dist.wire.messages import Release

MARKERS = {"h1": -8.0, "h2": -4.0, "h3": 0.0, "h4": 4.0, "h5": 8.0}
X = 1  # place of x in a snapshot, after the time

torque = st.one_of(st.floats(-1, 1), st.sampled_from([-1.0, 0.0, 1.0]))
torques = st.lists(st.lists(torque, min_size=6, max_size=6), min_size=1, max_size=15)


def run(env: HalfCheetahEnv, actions: Any) -> dict[str, Any]:
    info: dict[str, Any] = {}
    for action in actions:
        *_, info = env.step(np.array(action))
    return info


def moved_to(env: HalfCheetahEnv, x: float, vx: float = 0.0) -> NDArray[np.float32]:
    """The present posture at another x, at rest but for ``vx``."""
    state = env.get_state()
    state[X] = x
    state[X + 9 : X + 18] = [vx, *[0.0] * 8]
    return env.set_state(state)


def over_the_wire(state: NDArray[np.float64]) -> NDArray[np.float64]:
    return decode(encode(Envelope(Release(pid="p1", epoch=1), {"state": state}))).arrays["state"]


def test_resets_and_steps_equal_gymnasiums_half_cheetah_bit_for_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("imageio", reason="gymnasium's MuJoCo environments import it")
    monkeypatch.chdir(tmp_path)  # MuJoCo 4 logs a deprecation of theirs into the current folder
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs: Any = gymnasium.make("HalfCheetah-v5", exclude_current_positions_from_observation=False).unwrapped
    ours = HalfCheetahEnv(observation="raw")
    generator = np.random.default_rng(0)
    for seed in (0, 1):
        assert ours.reset(seed=seed)[0].tolist() == theirs.reset(seed=seed)[0].astype(np.float32).tolist()
        for _ in range(200):
            action = generator.uniform(-1, 1, 6).astype(np.float32)
            observation = theirs.step(action)[0]
            assert ours.step(action)[0].tolist() == observation.astype(np.float32).tolist()
            assert ours.get_state()[X : X + 18].tolist() == observation.tolist()


@pytest.mark.parametrize(
    ("x", "labels"),
    [(x + offset, {name}) for name, x in MARKERS.items() for offset in (-0.25, 0.0, 0.25)]
    + [(x + offset, set()) for x in MARKERS.values() for offset in (-0.35, 0.35)]
    + [(2.0, set()), (100.0, set())],
)
def test_a_marker_is_true_closer_than_0_3(x: float, labels: set[str]) -> None:
    env = HalfCheetahEnv()
    env.reset(seed=0)
    moved_to(env, x)
    info = run(env, [np.zeros(6)])
    assert abs(env.get_state()[X] - x) < 0.05  # it hardly moves within one step from rest
    assert info["labels"] == labels


def test_markers_are_of_the_position_after_the_step() -> None:
    env = HalfCheetahEnv()
    env.reset(seed=0)
    moved_to(env, 3.6, 3.0)
    assert run(env, [np.zeros(6)])["labels"] == {"h4"}
    assert env.get_state()[X] > 3.7
    moved_to(env, 4.2, 4.0)
    assert run(env, [np.zeros(6)])["labels"] == set()
    assert env.get_state()[X] > 4.3


def test_a_step_is_five_hundredths_of_a_second() -> None:
    env = HalfCheetahEnv()
    env.reset(seed=0)
    for count in range(1, 4):
        run(env, [np.zeros(6)])
        assert env.get_state()[0] == pytest.approx(0.05 * count)


def test_the_reset_is_near_the_third_marker_with_noise_decided_by_the_seed() -> None:
    env = HalfCheetahEnv(observation="raw")
    drawn = np.array([env.reset(seed=seed)[0] for seed in range(200)])
    assert env.reset(seed=5)[1]["labels"] == {"h3"}
    assert np.array_equal(env.reset(seed=5)[0], drawn[5])
    positions, velocities = drawn[:, :9], drawn[:, 9:]
    assert np.abs(positions).max() <= 0.1
    assert np.abs(positions).max(axis=0).min() > 0.09
    np.testing.assert_allclose(velocities.std(axis=0), 0.1, atol=0.025)


@settings(max_examples=25)
@given(st.integers(0, 1000), st.sampled_from(["features", "raw"]), torques, torques)
def test_a_restored_snapshot_has_the_same_future_bit_for_bit(
    seed: int, observation: Any, before: list[Any], after: list[Any]
) -> None:
    first = HalfCheetahEnv(observation=observation)
    first.reset(seed=seed)
    run(first, before)
    here = first.step(np.zeros(6))[0]
    second = HalfCheetahEnv(observation=observation)
    second.reset(seed=seed + 1)
    run(second, after)
    assert second.set_state(over_the_wire(first.get_state())).tobytes() == here.tobytes()
    for action in after:
        one, two = first.step(np.array(action)), second.step(np.array(action))
        assert one[0].tobytes() == two[0].tobytes()
        assert one[1:] == two[1:]
        assert first.get_state().tobytes() == second.get_state().tobytes()


def test_the_snapshot_holds_the_warm_start_without_which_the_future_differs() -> None:
    assert mujoco.mj_stateSize(load_model(), mujoco.mjtState.mjSTATE_WARMSTART) == 9
    env, whole, without = HalfCheetahEnv(), HalfCheetahEnv(), HalfCheetahEnv()
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (400, 6))
    differing = 0
    for start in range(0, 400, 10):
        whole.set_state(env.get_state())
        cold = env.get_state()
        cold[X + 18 : X + 27] = 0
        without.set_state(cold)
        for each in (env, whole, without):
            run(each, actions[start : start + 10])
        assert np.array_equal(env.get_state(), whole.get_state())
        differing += not np.array_equal(env.get_state(), without.get_state())
    assert differing > 0


def test_rendering_leaves_the_future_alone() -> None:
    drawn, plain = HalfCheetahEnv(render_mode="rgb_array"), HalfCheetahEnv()
    actions = np.random.default_rng(1).uniform(-1, 1, (10, 6))
    for env in (drawn, plain):
        env.reset(seed=3)
    for action in actions:
        drawn.render()
        run(drawn, [action])
        run(plain, [action])
    assert np.array_equal(drawn.get_state(), plain.get_state())


@pytest.mark.slow
def test_ten_thousand_random_steps_stay_within_all_ranges_with_right_labels() -> None:
    env = HalfCheetahEnv()
    env.reset(seed=0)
    generator = np.random.default_rng(0)
    seen: set[str] = set()
    clipped = np.zeros(18)
    for step in range(10_000):
        if step % 100 == 0:
            moved_to(env, generator.uniform(-9, 9))
        observation, _, _, _, info = env.step(generator.uniform(-1, 1, 6).astype(np.float32))
        assert env.observation_space.contains(observation)
        x = float(env.get_state()[X])
        assert info["labels"] == {name for name, marker in MARKERS.items() if -0.3 < x - marker < 0.3}
        clipped += np.abs(observation[:18]) == 1
        seen |= info["labels"]
    assert seen == set(MARKERS)
    assert clipped.max() < 10  # the scales suit the motion


def test_features_as_computed_by_hand() -> None:
    env = HalfCheetahEnv()
    env.reset(seed=0)
    state = env.get_state()
    state[X : X + 9] = [-5.0, 0.2, np.pi + 20 * np.pi, 0.25, -0.5, 0.125, 0, 1.0, -2.0]
    state[X + 9 : X + 18] = [5.0, -3.0, 6.0, 15.0, -40.0, 3.0, 0.0, 0.0, 0.0]
    seen = env.set_state(state)
    np.testing.assert_allclose(seen[:9], [-0.5, 0.2, 0, 0.2, -0.4, 0.1, 0, 0.8, -1], atol=1e-6)
    np.testing.assert_allclose(seen[9:18], [0.5, -0.5, 0.5, 0.5, -1, 0.1, 0, 0, 0], atol=1e-6)
    assert seen[18] == pytest.approx(-1)
    np.testing.assert_allclose(seen[19:], [-0.75, 0.25, 1, 1, 1], atol=1e-6)


@pytest.mark.parametrize("observation", ["features", "raw"])
def test_gymnasiums_checker_is_content(observation: str) -> None:
    env = gymnasium.make("t4nmtd/HalfCheetah-v0", observation=observation, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*A Box observation space .*infinity")  # raw has no bounds
        check_env(env.unwrapped)


def test_the_world_is_registered_without_a_step_limit() -> None:
    env = gymnasium.make("t4nmtd/HalfCheetah-v0")
    assert env.spec is not None
    assert env.spec.max_episode_steps is None
    assert isinstance(env.unwrapped, SnapshotEnv)
    assert env.unwrapped.propositions == tuple(MARKERS)


def test_loading_the_model_writes_no_log_into_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    load_model.__wrapped__()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "action", [[np.nan] * 6, [0, 0, 0, 0, 0, 1.01], [-np.inf] * 6, [0] * 5, [[0] * 6], "abcdef", None]
)
def test_a_bad_action_is_refused_by_space_and_value(action: Any) -> None:
    env = HalfCheetahEnv()
    env.reset(seed=0)
    before = env.get_state()
    with pytest.raises(ValueError, match=r"Box\(-1\.0, 1\.0, \(6,\), float32\)") as refused:
        env.step(action)
    assert repr(action) in str(refused.value)
    assert np.array_equal(env.get_state(), before)


BAD_SNAPSHOTS = {
    "finite": np.full(91, np.nan),
    r"HalfCheetah.*\(1, 91\)": np.zeros(76),
    "dtype kind": np.zeros(91, dtype=int),
    "list": [0.0] * 91,
    "NoneType": None,
}


@pytest.mark.parametrize("reason", BAD_SNAPSHOTS)
def test_what_is_no_snapshot_is_refused_and_changes_nothing(reason: str) -> None:
    env = HalfCheetahEnv()
    env.reset(seed=0)
    before = env.get_state()
    bad: Any = BAD_SNAPSHOTS[reason]
    with pytest.raises(ValueError, match=reason):
        env.set_state(bad)
    assert np.array_equal(env.get_state(), before)


@pytest.mark.parametrize("arguments", [{"observation": "pixels"}, {"render_mode": "human"}])
def test_bad_options_are_refused_by_name(arguments: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(arguments))):
        HalfCheetahEnv(**arguments)


def test_a_frame_shows_the_body_above_the_ground_the_markers_and_the_labels() -> None:
    env = HalfCheetahEnv(render_mode="rgb_array")
    env.reset(seed=0)
    moved_to(env, 4.0)
    at_marker = env.render()
    moved_to(env, 5.0)
    beside = env.render()
    assert at_marker is not None
    assert beside is not None
    assert (at_marker.shape, at_marker.dtype) == ((356, 640, 3), np.uint8)
    green = np.array([0, 158, 115])
    assert (np.abs(at_marker.astype(int) - green).sum(axis=-1) < 10).sum() > 200
    assert (np.abs(beside.astype(int) - green).sum(axis=-1) < 10).sum() == 0
    assert (at_marker[320:] != beside[320:]).any()
    torso = at_marker[200:280, 270:370].reshape(-1, 3).sum(axis=-1)
    assert (torso < 200).any()
    assert HalfCheetahEnv().render() is None
