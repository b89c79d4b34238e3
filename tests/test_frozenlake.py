"""FrozenLake: the rules against a second statement of them, snapshots, the batch, observations, bad input."""

from __future__ import annotations

import subprocess
import sys
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import envs
from envs.frozenlake import FrozenLakeEnv, FrozenLakeVectorEnv
from envs.frozenlake_rules import MAPS
from envs.protocol import SnapshotEnv, SnapshotVectorEnv

LEFT, DOWN, RIGHT, UP, PICK, DROP = range(6)
ICE = {goals: [cell for cell, tile in enumerate("".join(MAPS[goals])) if tile != "H"] for goals in MAPS}
HOLES = {goals: [cell for cell, tile in enumerate("".join(MAPS[goals])) if tile == "H"] for goals in MAPS}
GOALS = {1: [45], 2: [45, 58]}

all_goals = st.sampled_from([1, 2])
all_actions = st.lists(st.integers(0, 5), min_size=1, max_size=30)


def snapshot(goals: int, cell: int, carrying: int = 0, *passengers: int, ended: int = 0) -> NDArray[np.int32]:
    return np.array([goals, cell, ended, carrying, *(passengers or (15, 27, 40))], dtype=np.int32)


@st.composite
def snapshots(draw: st.DrawFn, goals: int) -> NDArray[np.int32]:
    """Any state in which the episode still goes on; passengers often near or under the agent."""
    cell = draw(st.sampled_from(ICE[goals]))
    near = [c for c in ICE[goals] if abs(c // 8 - cell // 8) + abs(c % 8 - cell % 8) <= 1]
    place = st.one_of(st.sampled_from(near), st.sampled_from(ICE[goals]))
    passengers = draw(st.lists(place, min_size=3, max_size=3))
    assume(len(set(passengers)) == 3)
    carrying = draw(st.integers(0, 3))
    if carrying:
        passengers[carrying - 1] = -1
    return snapshot(goals, cell, carrying, *passengers)


def reference_step(state: list[int], action: int) -> tuple[list[int], set[str]]:
    """The specification once more, in plain words: the next snapshot and its labels."""
    goals, cell, ended, carrying, *passengers = state
    if not ended:
        row, column = divmod(cell, 8)
        if action == PICK and carrying == 0 and cell in passengers:
            carrying = passengers.index(cell) + 1
            passengers[carrying - 1] = -1
        elif action == DROP and carrying != 0 and cell not in passengers:
            passengers[carrying - 1] = cell
            carrying = 0
        elif action <= UP and goals == 1 and cell == 45:
            ended = 1
        elif action <= UP:
            row += {DOWN: 1, UP: -1}.get(action, 0)
            column += {RIGHT: 1, LEFT: -1}.get(action, 0)
            cell = 8 * min(max(row, 0), 7) + min(max(column, 0), 7)
            ended = int(MAPS[goals][cell // 8][cell % 8] == "H")
    labels = {f"p{carrying}"} if carrying else set()
    if cell in GOALS[goals]:
        labels.add("g" if goals == 1 else {45: "g1", 58: "g2"}[cell])
    return [goals, cell, ended, carrying, *passengers], labels


def walk(env: FrozenLakeEnv, *actions: int) -> tuple[list[int], bool, frozenset[str]]:
    terminated, info = False, {"labels": frozenset()}
    for action in actions:
        _, _, terminated, _, info = env.step(action)
    return env.get_state().tolist(), terminated, info["labels"]


def test_the_maps_hold_passengers_goals_and_holes_where_the_tasks_say() -> None:
    assert HOLES[1] == [6, 10, 16, 18, 21, 30, 34, 39, 41, 42, 49, 55, 58, 61]
    assert HOLES[2] == [6, 10, 16, 18, 21, 30, 34, 39, 49, 55, 61]
    for goals in (1, 2):
        assert FrozenLakeEnv(goals=goals).get_state().tolist() == [goals, 0, 0, 0, 15, 27, 40]
        tiles = "".join(MAPS[goals])
        assert [cell for cell, tile in enumerate(tiles) if tile == "G"] == GOALS[goals]


def test_a_passenger_can_be_brought_to_the_goal_of_task_7() -> None:
    env = FrozenLakeEnv()
    to_passenger = (RIGHT, DOWN, DOWN, DOWN, RIGHT, RIGHT)
    assert walk(env, *to_passenger) == ([1, 27, 0, 0, 15, 27, 40], False, frozenset())
    assert walk(env, PICK) == ([1, 27, 0, 2, 15, -1, 40], False, {"p2"})
    assert walk(env, DOWN, DOWN, RIGHT, RIGHT) == ([1, 45, 0, 2, 15, -1, 40], False, {"p2", "g"})
    assert walk(env, DROP) == ([1, 45, 0, 0, 15, 45, 40], False, {"g"})


@pytest.mark.parametrize("move", [LEFT, DOWN, RIGHT, UP])
def test_quirk_any_move_from_the_goal_of_task_7_ends_the_episode_there(move: int) -> None:
    env = FrozenLakeEnv(goals=1)
    env.set_state(snapshot(1, 45, 2, 15, -1, 40))
    assert walk(env, move) == ([1, 45, 1, 2, 15, -1, 40], True, {"p2", "g"})


def test_quirk_picking_and_dropping_on_the_goal_of_task_7_does_not_end_the_episode() -> None:
    env = FrozenLakeEnv(goals=1)
    env.set_state(snapshot(1, 45, 0, 15, 45, 40))
    assert walk(env, DROP, PICK) == ([1, 45, 0, 2, 15, -1, 40], False, {"p2", "g"})


def test_the_goals_of_task_8_are_passable() -> None:
    env = FrozenLakeEnv(goals=2)
    env.set_state(snapshot(2, 44, 1, -1, 27, 40))
    assert walk(env, RIGHT) == ([2, 45, 0, 1, -1, 27, 40], False, {"p1", "g1"})
    assert walk(env, RIGHT) == ([2, 46, 0, 1, -1, 27, 40], False, {"p1"})
    env.set_state(snapshot(2, 57, 3, 15, 27, -1))
    assert walk(env, RIGHT) == ([2, 58, 0, 3, 15, 27, -1], False, {"p3", "g2"})
    assert walk(env, RIGHT)[:2] == ([2, 59, 0, 3, 15, 27, -1], False)


def test_a_hole_ends_the_episode_and_labels_tell_who_is_carried() -> None:
    env = FrozenLakeEnv(goals=1)
    env.set_state(snapshot(1, 40, 3, 15, 27, -1))
    assert walk(env, RIGHT) == ([1, 41, 1, 3, 15, 27, -1], True, {"p3"})
    assert walk(env, DROP, UP) == ([1, 41, 1, 3, 15, 27, -1], True, {"p3"})


def test_hands_hold_one_passenger_and_a_cell_takes_one() -> None:
    env = FrozenLakeEnv()
    env.set_state(snapshot(1, 27, 1, -1, 27, 40))
    for action in (PICK, DROP):
        assert walk(env, action) == ([1, 27, 0, 1, -1, 27, 40], False, {"p1"})


@given(st.data(), all_goals, all_actions)
def test_every_step_follows_the_specification(data: st.DataObject, goals: int, actions: list[int]) -> None:
    env = FrozenLakeEnv(goals=goals)
    expected = data.draw(snapshots(goals)).tolist()
    env.set_state(np.array(expected))
    for action in actions:
        expected, labels = reference_step(expected, action)
        _, reward, terminated, truncated, info = env.step(action)
        assert env.get_state().tolist() == expected
        assert (reward, terminated, truncated, info["labels"]) == (0.0, bool(expected[2]), False, labels)


@pytest.mark.parametrize("goals", [1, 2])
def test_moves_and_holes_agree_with_gymnasiums_frozen_lake(goals: int) -> None:
    theirs = gymnasium.make("FrozenLake-v1", desc=list(MAPS[goals]), is_slippery=False).unwrapped
    ours = FrozenLakeEnv(goals=goals)
    for cell in set(ICE[goals]) - set(GOALS[goals] if goals == 2 else []):
        for action in (LEFT, DOWN, RIGHT, UP):
            [(_, landed, _, done)] = theirs.P[cell][action]
            ours.set_state(snapshot(goals, cell, 0, *[c for c in ICE[goals] if c != cell][:3]))
            state, terminated, _ = walk(ours, action)
            assert state[1] == landed
            if landed not in GOALS[goals] or cell in GOALS[goals]:
                assert terminated == done


@given(st.data(), all_goals, st.sampled_from(["features", "raw"]), all_actions, all_actions)
def test_a_restored_snapshot_has_the_same_future_bit_for_bit(
    data: st.DataObject, goals: int, observation: Any, before: list[int], after: list[int]
) -> None:
    first = FrozenLakeEnv(goals=goals, observation=observation)
    first.set_state(data.draw(snapshots(goals)))
    walk(first, *before)
    taken = first.get_state()
    received = np.frombuffer(taken.tobytes(), dtype=taken.dtype)  # read-only, as from the wire
    second = FrozenLakeEnv(goals=goals, observation=observation)
    second.set_state(received)
    for action in after:
        here, there = first.step(action), second.step(action)
        assert here[0].tobytes() == there[0].tobytes()
        assert here[1:] == there[1:]
        assert first.get_state().tobytes() == second.get_state().tobytes()


@pytest.mark.slow
@settings(max_examples=60)
@given(st.data(), all_goals, st.sampled_from(["features", "raw"]))
def test_the_batch_steps_as_single_lakes_do(data: st.DataObject, goals: int, observation: Any) -> None:
    starts = np.array(data.draw(st.lists(snapshots(goals), min_size=1, max_size=5)))
    count = len(starts)
    batch = FrozenLakeVectorEnv(count, goals=goals, observation=observation)
    singles = [FrozenLakeEnv(goals=goals, observation=observation) for _ in range(count)]
    together = batch.set_states(np.arange(count), starts)
    apart = [env.set_state(start) for env, start in zip(singles, starts, strict=True)]
    assert together.tobytes() == np.array(apart).tobytes()
    for _ in range(data.draw(st.integers(1, 12))):
        actions = data.draw(st.lists(st.integers(0, 5), min_size=count, max_size=count))
        observations, rewards, terminated, truncated, info = batch.step(np.array(actions))
        results = [env.step(action) for env, action in zip(singles, actions, strict=True)]
        assert observations.tobytes() == np.array([r[0] for r in results]).tobytes()
        assert terminated.tolist() == [r[2] for r in results]
        named = [set(np.array(batch.propositions)[row]) for row in info["labels"]]
        assert named == [r[4]["labels"] for r in results]
        assert not rewards.any()
        assert not truncated.any()
        snapshots_apart = np.array([env.get_state() for env in singles])
        assert np.array_equal(batch.get_states(range(count)), snapshots_apart)


@given(st.data(), all_goals)
def test_features_tell_the_whole_state(data: st.DataObject, goals: int) -> None:
    env = FrozenLakeEnv(goals=goals)
    state = data.draw(snapshots(goals))
    features = env.set_state(state)
    cell, carrying = int(np.argmax(features[:64])), int(np.argmax(features[64:68]))
    passengers = features[68:].reshape(3, 5)
    cells = np.rint((passengers[:, 0] + 1) * 3.5) * 8 + np.rint((passengers[:, 1] + 1) * 3.5)
    offsets = np.rint(passengers[:, 2] * 7) * 8 + np.rint(passengers[:, 3] * 7)
    assert cell == state[1]
    assert carrying == state[3]
    assert features[:68].sum() == 2
    for number, position in enumerate(state[4:]):
        assert cells[number] == (cell if position == -1 else position)
        assert offsets[number] == cells[number] - cell
        assert passengers[number, 4] == (position == cell)


def test_observations_as_computed_by_hand() -> None:
    raw = FrozenLakeEnv(observation="raw")
    assert raw.reset()[0].tolist() == [0, 0, 1, 7, 3, 3, 5, 0]
    assert raw.set_state(snapshot(1, 45, 2, 15, -1, 40)).tolist() == [45, 2, 1, 7, -1, -1, 5, 0]
    features = FrozenLakeEnv().set_state(snapshot(1, 15, 2, 15, -1, 40))
    np.testing.assert_array_equal(np.flatnonzero(features[:68]), [15, 64 + 2])
    by_passenger = [[-5 / 7, 1, 0, 0, 1], [-5 / 7, 1, 0, 0, 0], [3 / 7, -1, 4 / 7, -1, 0]]
    np.testing.assert_allclose(features[68:], np.ravel(by_passenger), atol=1e-6)


@pytest.mark.parametrize("goals", [1, 2])
@pytest.mark.parametrize("observation", ["features", "raw"])
def test_gymnasiums_checker_is_content(goals: int, observation: str) -> None:
    env = gymnasium.make("t4nmtd/FrozenLake-v0", goals=goals, observation=observation, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_worlds_are_registered_without_a_step_limit_and_only_once() -> None:
    spec = gymnasium.spec("t4nmtd/FrozenLake-v0")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        envs.register_environments()
    assert gymnasium.spec("t4nmtd/FrozenLake-v0") is spec
    assert spec.max_episode_steps is None
    assert isinstance(gymnasium.make("t4nmtd/FrozenLake-v0", goals=2).unwrapped, SnapshotEnv)
    batch = gymnasium.make_vec("t4nmtd/FrozenLake-v0", 3, vectorization_mode="vector_entry_point", goals=2)
    assert isinstance(batch, FrozenLakeVectorEnv)
    assert isinstance(batch, SnapshotVectorEnv)
    assert batch.propositions == ("p1", "p2", "p3", "g1", "g2")
    assert batch.step([RIGHT] * 3)[0] in batch.observation_space


@pytest.mark.command
def test_an_id_naming_the_package_needs_no_import_and_loads_nothing_heavy() -> None:
    program = (
        "import sys, gymnasium; gymnasium.make('envs:t4nmtd/FrozenLake-v0').reset(); "
        "print([m for m in ('torch', 'mujoco', 'pymunk', 'PIL', 't4nmtd_dist') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "[]", done.stderr


@pytest.mark.parametrize("action", [6, -1, 1.0, float("nan"), "left", None, True, [1], np.array([1])])
def test_a_bad_action_is_refused_by_space_and_value(action: Any) -> None:
    env = FrozenLakeEnv()
    with pytest.raises(ValueError, match=r"Discrete\(6\)") as refused:
        env.step(action)
    assert repr(action) in str(refused.value)


@pytest.mark.parametrize(
    "actions", [[0, 6], [-1, 0], [0.0, 1.0], [np.nan, 0], [0], [0, 0, 0], [[0, 0]], "ab", [True, False]]
)
def test_bad_actions_of_a_batch_are_refused_and_move_nobody(actions: Any) -> None:
    batch = FrozenLakeVectorEnv(2)
    with pytest.raises(ValueError, match=r"Discrete\(6\)"):
        batch.step(actions)
    assert batch.get_states([0, 1])[:, 1].tolist() == [0, 0]


BAD_SNAPSHOTS = {
    "goals": snapshot(2, 0),
    "its cell": snapshot(1, 64),
    "ended is neither": snapshot(1, 45, ended=2),
    "where no episode ends": snapshot(1, 0, ended=1),
    "goes on in a hole": snapshot(1, 6),
    "carrying is not": snapshot(1, 0, 4),
    "at -1": snapshot(1, 0, 1, 15, -1, 40),
    "not exactly": snapshot(1, 0, 0, 15, -1, 40),
    "nor on ice": snapshot(1, 0, 0, 6, 27, 40),
    "neither carried": snapshot(1, 0, 0, 64, 27, 40),
    "on one cell": snapshot(1, 0, 0, 27, 27, 40),
    r"shape \(1, 7\)": snapshot(1, 0)[:6],
    "dtype kind": snapshot(1, 0).astype(np.float32),
    "got list": snapshot(1, 0).tolist(),
    "NoneType": None,
}


@pytest.mark.parametrize("reason", BAD_SNAPSHOTS)
def test_what_is_no_snapshot_is_refused_and_changes_nothing(reason: str) -> None:
    env, batch = FrozenLakeEnv(), FrozenLakeVectorEnv(2)
    bad = BAD_SNAPSHOTS[reason]
    env.step(RIGHT)
    before = env.get_state()
    with pytest.raises(ValueError, match=reason):
        env.set_state(bad)
    assert np.array_equal(env.get_state(), before)
    if isinstance(bad, np.ndarray) and bad.shape == (7,):
        with pytest.raises(ValueError, match=reason):
            batch.set_states([1, 0], np.stack([before.astype(bad.dtype), bad]))
        assert np.array_equal(batch.get_states([0, 1]), [snapshot(1, 0)] * 2)


@pytest.mark.parametrize("indices", [[2], [-1], [0.5], [[0]], [True], ["a"]])
def test_bad_row_indices_are_refused(indices: Any) -> None:
    batch = FrozenLakeVectorEnv(2)
    with pytest.raises(ValueError, match="row ind"):
        batch.get_states(indices)
    with pytest.raises(ValueError, match="row ind"):
        batch.set_states(indices, snapshot(1, 0)[None])
    with pytest.raises(ValueError, match="differ"):
        batch.set_states([1, 1], np.stack([snapshot(1, 0)] * 2))


@pytest.mark.parametrize(
    "arguments",
    [{"goals": 3}, {"goals": True}, {"goals": "1"}, {"observation": "pixels"}, {"render_mode": "human"}],
)
def test_bad_options_are_refused_by_name(arguments: dict[str, Any]) -> None:
    for make in (FrozenLakeEnv, FrozenLakeVectorEnv):
        with pytest.raises(ValueError, match=next(iter(arguments))):
            make(**arguments)
    with pytest.raises(ValueError, match="num_envs"):
        FrozenLakeVectorEnv(0)


def test_a_terminated_row_stays_until_it_is_reset_or_set() -> None:
    batch = FrozenLakeVectorEnv(3)
    batch.set_states([0, 1], np.stack([snapshot(1, 5), snapshot(1, 45, 2, 15, -1, 40)]))
    for action in (RIGHT, LEFT, DROP):
        _, _, terminated, _, info = batch.step([action] * 3)
        assert terminated.tolist() == [True, True, False]
        assert info["labels"].tolist()[1] == [False, True, False, True]
    observations, info = batch.reset(seed=3, options={"reset_mask": np.array([True, False, False])})
    assert batch.get_states([0, 1]).tolist() == [[1, 0, 0, 0, 15, 27, 40], [1, 45, 1, 2, 15, -1, 40]]
    assert observations.shape == (3, 83)
    assert info["labels"].shape == (3, 4)
    batch.set_states([1], snapshot(1, 0)[None])
    assert batch.step([RIGHT] * 3)[2].tolist() == [False] * 3
    assert np.array_equal(batch.reset()[0], np.stack([FrozenLakeEnv().reset()[0]] * 3))


@pytest.mark.parametrize("mask", [[True, False], np.array([1, 0]), np.array([True]), np.zeros(2, dtype=bool)])
def test_a_bad_reset_mask_is_refused(mask: Any) -> None:
    with pytest.raises(ValueError, match="reset_mask"):
        FrozenLakeVectorEnv(2).reset(options={"reset_mask": mask})


def test_returned_arrays_are_not_reused() -> None:
    batch = FrozenLakeVectorEnv(2)
    results = [batch.step([action] * 2) for action in (RIGHT, DOWN)]
    states = [batch.get_states([0, 1]) for _ in range(2)]
    for first, second in [*zip(results[0][:4], results[1][:4], strict=True), states]:
        assert not np.shares_memory(first, second)
    assert not np.shares_memory(results[0][4]["labels"], results[1][4]["labels"])
    kept = results[1][0].copy()
    batch.set_states([0], snapshot(1, 45)[None])
    assert np.array_equal(results[1][0], kept)


def test_no_rows_may_be_read_and_set() -> None:
    batch = FrozenLakeVectorEnv(2)
    nothing = batch.get_states(np.flatnonzero([False, False]))
    assert batch.set_states([], nothing).shape == (0, 83)


@pytest.mark.parametrize("goals", [1, 2])
def test_a_frame_shows_agent_passengers_goal_holes_and_labels(goals: int) -> None:
    env = FrozenLakeEnv(goals=goals, render_mode="rgb_array")
    empty = env.render()
    assert empty is not None
    assert (empty.shape, empty.dtype) == ((420, 384, 3), np.uint8)
    dark, pale = empty[24, 6 * 48 + 24], empty[24, 5 * 48 + 24]  # a hole and the ice beside it
    assert dark.sum() < 200 < 600 < pale.sum()
    env.set_state(snapshot(goals, 45, 2, 15, -1, 40))
    carrying = env.render()
    assert carrying is not None
    changed = (carrying != empty).any(axis=-1)
    tile = {cell: changed[cell // 8 * 48 :, cell % 8 * 48 :][:48, :48].any() for cell in (0, 6, 15, 27, 45)}
    assert tile == {0: True, 6: False, 15: False, 27: True, 45: True}
    assert changed[384:].any()
    frames = FrozenLakeVectorEnv(2, goals=goals, render_mode="rgb_array").render()
    assert frames is not None
    assert all(np.array_equal(frame, empty) for frame in frames)
    assert FrozenLakeEnv().render() is None
    assert FrozenLakeVectorEnv().render() is None
