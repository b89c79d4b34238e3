"""Waterworld: maps, quirks by hand, a second statement of the rules, snapshots, the batch, bad input."""

from __future__ import annotations

import subprocess
import sys
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from ponds import BLUE, COLOURS, GREEN, RED, colour_counts, command, commands, pond, run, snapshots

from envs.protocol import SnapshotEnv, SnapshotVectorEnv
from envs.waterworld import WaterworldEnv, WaterworldVectorEnv
from envs.waterworld_ponds import COPIES_PER_SPACE
from t4nmtd_dist.wire.codec import Envelope, decode, encode
from t4nmtd_dist.wire.messages import Release

observations = st.sampled_from(["features", "raw"])


def reference_step(state: list[float], action: tuple[float, float]) -> tuple[list[float], set[str]]:
    """The specification once more, in plain words: the next snapshot and the labels of the step."""
    rows = [state[i : i + 4] for i in range(0, len(state), 4)]
    names = COLOURS[(len(rows) - 1) // 3]
    ax, ay = rows[-1][:2]
    labels = set()
    for number, (x, y, _, _) in enumerate(rows[:-1]):
        # The boxes of half-width 0.5 overlap, as pymunk computes it.
        if x - 0.5 <= ax + 0.5 and ax - 0.5 <= x + 0.5 and y - 0.5 <= ay + 0.5 and ay - 0.5 <= y + 0.5:
            labels.add(names[number // 3])
    after = []
    for number, row in enumerate(rows):
        is_agent = number == len(rows) - 1
        new = list(row)
        for axis in (0, 1):
            moved = row[axis] + row[axis + 2]
            if moved >= 30 or moved <= 0:
                new[axis], new[axis + 2] = (30.0 if moved >= 30 else 0.0), -row[axis + 2]
            else:
                new[axis] = moved
                if is_agent:
                    new[axis + 2] = action[axis]
        after += new
    return after, labels


def over_the_wire(state: NDArray[np.float64]) -> NDArray[np.float64]:
    sent = Envelope(Release(pid="p1", epoch=1), {"state": state})
    return decode(encode(sent)).arrays["state"]


def test_the_paper_maps_start_as_the_specification_lists_them() -> None:
    state = WaterworldEnv(colours=6).get_state().reshape(19, 4).astype(int).tolist()
    assert state[0] == [2, 27, -1, 0]
    assert state[3] == [23, 0, 2, 0]
    assert state[7] == [1, 27, -2, -2]
    assert state[17] == [2, 4, 1, -1]
    assert state[18] == [15, 15, 0, 0]
    assert np.sum(state[:18], axis=0).tolist() == [285, 230, 5, -6]
    state = WaterworldEnv(colours=8).get_state().reshape(25, 4).astype(int).tolist()
    assert state[0] == [18, 3, -1, -2]
    assert state[2] == [19, 19, 3, -1]
    assert state[8] == [22, 13, -3, 3]
    assert state[23] == [30, 23, 0, 2]
    assert state[24] == [15, 15, 0, 0]
    assert np.sum(state[:24], axis=0).tolist() == [375, 300, -9, 10]


def test_quirk_a_command_moves_the_agent_one_step_later() -> None:
    env = WaterworldEnv()
    assert run(env, (2.0, -1.0))[0] == [15, 15, 2, -1]
    assert run(env, (0.5, 3.5))[0] == [17, 14, 0.5, 3.5]
    assert run(env, (0.0, 0.0))[0] == [17.5, 17.5, 0, 0]


def test_quirk_at_a_wall_the_axis_is_reversed_and_its_command_ignored() -> None:
    env = WaterworldEnv()
    env.set_state(pond((29, 10, 1.5, 1)))
    assert run(env, (-3.0, 2.0))[0] == [30, 11, -1.5, 2]
    assert run(env, (3.5, 2.0))[0] == [28.5, 13, 3.5, 2]
    env.set_state(pond((1, 1, -1, -2)))  # arriving exactly on a wall counts as being at it
    assert run(env, (3.0, 3.0))[0] == [0, 0, 1, 2]


def test_balls_keep_their_speed_and_are_reflected_by_walls() -> None:
    env = WaterworldEnv()
    env.set_state(pond((15, 15, 0, 0), {0: (29, 1, 2, -2), 4: (15, 28, 0, 2), 9: (15, 28, 0, -2)}))
    balls = []
    for _ in range(3):
        run(env, (0, 0))
        state = env.get_state().reshape(19, 4)
        balls.append(state[[0, 4, 9]].tolist())
    assert balls[0] == [[30, 0, -2, 2], [15, 30, 0, -2], [15, 26, 0, -2]]
    assert balls[1] == [[28, 2, -2, 2], [15, 28, 0, -2], [15, 24, 0, -2]]
    assert balls[2] == [[26, 4, -2, 2], [15, 26, 0, -2], [15, 22, 0, -2]]


@pytest.mark.parametrize(
    ("dx", "dy", "touched"),
    [(1, 1, True), (-1, 1, True), (0.5, -1, True), (1.0001, 0, False), (0, -1.0001, False), (0, 0, True)],
)
def test_quirk_touching_is_decided_by_boxes_borders_included(dx: float, dy: float, touched: bool) -> None:
    env = WaterworldEnv()
    env.set_state(pond((15 - dx, 15 - dy, 0, 0), {BLUE: (15, 15, 0, 0)}))
    assert run(env, (0, 0))[1] == ({"blue"} if touched else set())


def test_quirk_labels_are_of_the_positions_before_the_move() -> None:
    env = WaterworldEnv()
    env.set_state(pond((15, 15, 0, 0), {RED: (15, 17, 0, -2), GREEN: (15, 15, 2, 0)}))
    assert run(env, (0, 0))[1] == {"green"}  # green is there and leaves; red arrives
    assert run(env, (0, 0))[1] == {"red"}
    assert run(env, (0, 0))[1] == set()


def test_a_ball_that_a_wall_stops_within_reach_is_touched() -> None:
    env = WaterworldEnv()
    env.set_state(pond((29, 15, 0, 0), {RED: (29, 18, 2, -2), GREEN: (29, 10, 2, 2)}))
    assert [run(env, (0, 0))[1] for _ in range(3)] == [set(), {"red"}, {"red", "green"}]


@given(st.data(), colour_counts, commands)
@pytest.mark.slow
def test_every_step_follows_the_specification(
    data: st.DataObject, colours: int, actions: list[tuple[float, float]]
) -> None:
    env = WaterworldEnv(colours=colours)
    expected = data.draw(snapshots(colours)).tolist()
    env.set_state(np.array(expected))
    for action in actions:
        expected, labels = reference_step(expected, action)
        _, reward, terminated, truncated, info = env.step(np.array(action))
        assert env.get_state().tolist() == expected
        assert (reward, terminated, truncated, info["labels"]) == (0.0, False, False, labels)


@pytest.mark.parametrize("colours", [6, 8])
@pytest.mark.slow
def test_ten_thousand_random_steps_follow_the_specification_within_all_ranges(colours: int) -> None:
    count = 10
    raw = WaterworldVectorEnv(count, colours=colours, observation="raw", map="random")
    features = WaterworldVectorEnv(count, colours=colours, map="random")
    raw.reset(seed=0)
    features.reset(seed=0)
    expected = raw.get_states(range(count)).tolist()
    actions = np.random.default_rng(0).uniform(-3.5, 3.5, (1000, count, 2)).astype(np.float32)
    seen = set()
    for action in actions:
        stepped = [reference_step(*pair) for pair in zip(expected, action.tolist(), strict=True)]
        expected = [state for state, _ in stepped]
        observations, _, _, _, info = raw.step(action)
        named = [set(np.array(raw.propositions)[row]) for row in info["labels"]]
        assert named == [labels for _, labels in stepped]
        assert observations.tolist() == np.array(expected, dtype=np.float32).tolist()
        assert observations in raw.observation_space
        assert features.step(action)[0] in features.observation_space
        seen |= set().union(*named)
    assert seen == set(COLOURS[colours])


@settings(max_examples=50)
@given(st.data(), colour_counts, observations, commands, commands)
def test_a_restored_snapshot_has_the_same_future_bit_for_bit(
    data: st.DataObject, colours: int, observation: Any, before: list[Any], after: list[Any]
) -> None:
    first = WaterworldEnv(colours=colours, observation=observation, map="random")
    first.reset(seed=data.draw(st.integers(0, 99)))
    run(first, *before)
    here = first.step(np.zeros(2))[0]
    second = WaterworldEnv(colours=colours, observation=observation)
    there = second.set_state(over_the_wire(first.get_state()))
    assert here.tobytes() == there.tobytes()
    for action in after:
        one, two = first.step(np.array(action)), second.step(np.array(action))
        assert one[0].tobytes() == two[0].tobytes()
        assert one[1:] == two[1:]
        assert first.get_state().tobytes() == second.get_state().tobytes()


@settings(max_examples=30)
@given(st.data(), colour_counts, observations)
@pytest.mark.slow
def test_the_batch_steps_as_single_worlds_do(data: st.DataObject, colours: int, observation: Any) -> None:
    starts = np.array(data.draw(st.lists(snapshots(colours), min_size=1, max_size=4)))
    count = len(starts)
    batch = WaterworldVectorEnv(count, colours=colours, observation=observation)
    singles = [WaterworldEnv(colours=colours, observation=observation) for _ in range(count)]
    together = batch.set_states(np.arange(count), starts)
    apart = [env.set_state(start) for env, start in zip(singles, starts, strict=True)]
    assert together.tobytes() == np.array(apart).tobytes()
    for _ in range(data.draw(st.integers(1, 8))):
        actions = np.array(data.draw(st.lists(st.tuples(command, command), min_size=count, max_size=count)))
        stepped, rewards, terminated, truncated, info = batch.step(actions)
        results = [env.step(action) for env, action in zip(singles, actions, strict=True)]
        assert stepped.tobytes() == np.array([r[0] for r in results]).tobytes()
        named = [set(np.array(batch.propositions)[row]) for row in info["labels"]]
        assert named == [r[4]["labels"] for r in results]
        assert not np.concatenate([rewards, terminated, truncated]).any()
        assert np.array_equal(batch.get_states(range(count)), [env.get_state() for env in singles])


def test_copies_do_not_notice_each_other_across_spaces() -> None:
    count = COPIES_PER_SPACE + 3
    batch = WaterworldVectorEnv(count, map="random", observation="raw")
    batch.reset(seed=5)
    singles = [WaterworldEnv(map="random", observation="raw") for _ in range(count)]
    for row, env in enumerate(singles):
        env.reset(seed=5 + row)
    generator = np.random.default_rng(1)
    for _ in range(40):
        actions = generator.uniform(-3.5, 3.5, (count, 2))
        stepped, _, _, _, info = batch.step(actions)
        results = [env.step(action) for env, action in zip(singles, actions, strict=True)]
        assert np.array_equal(stepped, [r[0] for r in results])
        named = [set(np.array(batch.propositions)[row]) for row in info["labels"]]
        assert named == [r[4]["labels"] for r in results]


def test_maps_are_drawn_once_per_seed_or_at_every_reset() -> None:
    drawn = {seed: WaterworldEnv(map=seed).get_state() for seed in (0, 1)}
    assert not np.array_equal(drawn[0], drawn[1])
    env = WaterworldEnv(map=1)
    run(env, (1, 1))
    env.reset(seed=77)
    assert np.array_equal(env.get_state(), drawn[1])
    fresh = WaterworldEnv(map="random")
    states = []
    for seed in (3, None, 3):
        fresh.reset(seed=seed)
        states.append(fresh.get_state())
    assert np.array_equal(states[0], states[2])
    assert not np.array_equal(states[0], states[1])


@pytest.mark.parametrize(("colours", "top"), [(6, 2), (8, 3)])
def test_random_maps_hold_whole_numbers_of_the_whole_range(colours: int, top: int) -> None:
    balls = [WaterworldEnv(colours=colours, map=s).get_state().reshape(-1, 4)[:-1] for s in range(60)]
    everything = np.concatenate(balls)
    assert np.array_equal(np.unique(everything[:, :2]), np.arange(31))
    assert np.array_equal(np.unique(everything[:, 2:]), np.arange(-top, top + 1))


@pytest.mark.parametrize("colours", [6, 8])
@pytest.mark.parametrize("observation", ["features", "raw"])
def test_gymnasiums_checker_is_content(colours: int, observation: str) -> None:
    env = gymnasium.make(
        "t4nmtd/Waterworld-v0", colours=colours, observation=observation, map="random", render_mode="rgb_array"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized")  # commands reach 3.5
        check_env(env.unwrapped)


def test_the_world_is_registered_with_its_batch_and_without_a_step_limit() -> None:
    assert gymnasium.spec("t4nmtd/Waterworld-v0").max_episode_steps is None
    assert isinstance(gymnasium.make("t4nmtd/Waterworld-v0").unwrapped, SnapshotEnv)
    batch = gymnasium.make_vec("t4nmtd/Waterworld-v0", 3, vectorization_mode="vector_entry_point", colours=8)
    assert isinstance(batch, WaterworldVectorEnv)
    assert isinstance(batch, SnapshotVectorEnv)
    assert batch.propositions == COLOURS[8]
    assert batch.step(batch.action_space.sample())[0] in batch.observation_space


@pytest.mark.command
def test_registering_imports_no_physics() -> None:
    program = "import sys, envs; print([m for m in ('pymunk', 'mujoco', 'PIL') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "[]", done.stderr


@pytest.mark.parametrize(
    "action",
    [[np.nan, 0], [0, np.inf], [3.6, 0], [0, -3.51], [0], [0, 0, 0], [[0, 0]], "ab", None, [True, False], 1.0],
)
def test_a_bad_action_is_refused_by_space_and_value(action: Any) -> None:
    env, batch = WaterworldEnv(), WaterworldVectorEnv(1)
    with pytest.raises(ValueError, match=r"Box\(-3\.5, 3\.5, \(2,\), float32\)") as refused:
        env.step(action)
    assert repr(action) in str(refused.value)
    with pytest.raises(ValueError, match=r"Box\(-3\.5, 3\.5"):
        batch.step([action])
    assert np.array_equal(env.get_state(), WaterworldEnv().get_state())
    assert np.array_equal(batch.get_states([0])[0], WaterworldEnv().get_state())


def test_an_action_outside_by_rounding_is_moved_onto_the_bound() -> None:
    assert run(WaterworldEnv(), (3.5000001, -3.5000001))[0][2:] == [3.5, -3.5]


BAD_SNAPSHOTS = {
    "a position is not": pond((15, 30.5, 0, 0)),
    "position is not in 0": pond((15, 15, 0, 0), {3: (-1, 3, 0, 0)}),
    "a ball is faster than 2": pond((15, 15, 0, 0), {3: (1, 3, 0, -3)}),
    "agent is faster than 3.5": pond((15, 15, 0, 4)),
    "must be finite": pond((15, np.nan, 0, 0)),
    r"with 18 balls.*\(1, 76\)": WaterworldEnv(colours=8).get_state(),
    "dtype kind": pond((15, 15, 0, 0)).astype(int),
    "got list": [0.0] * 76,
    "NoneType": None,
}


@pytest.mark.parametrize("reason", BAD_SNAPSHOTS)
def test_what_is_no_snapshot_is_refused_and_changes_nothing(reason: str) -> None:
    env, batch = WaterworldEnv(), WaterworldVectorEnv(2)
    bad: Any = BAD_SNAPSHOTS[reason]
    run(env, (1, 2))
    before = env.get_state()
    with pytest.raises(ValueError, match=reason):
        env.set_state(bad)
    assert np.array_equal(env.get_state(), before)
    if isinstance(bad, np.ndarray) and bad.shape == before.shape and bad.dtype == np.float64:
        with pytest.raises(ValueError, match=reason):
            batch.set_states([1, 0], np.stack([before, bad]))
        assert np.array_equal(batch.get_states([0, 1]), [WaterworldEnv().get_state()] * 2)


@pytest.mark.parametrize(
    "arguments",
    [
        {"colours": 7},
        {"colours": 6.0},
        {"map": "papers"},
        {"map": -1},
        {"map": True},
        {"map": 1.5},
        {"observation": "pixels"},
        {"render_mode": "human"},
    ],
)
def test_bad_options_are_refused_by_name(arguments: dict[str, Any]) -> None:
    for make in (WaterworldEnv, WaterworldVectorEnv):
        with pytest.raises(ValueError, match=next(iter(arguments))):
            make(**arguments)
    with pytest.raises(ValueError, match="num_envs"):
        WaterworldVectorEnv(0)


def test_rows_are_reset_and_set_alone_and_bad_indices_refused() -> None:
    batch = WaterworldVectorEnv(3, observation="raw")
    start = WaterworldEnv().get_state()
    batch.step(np.ones((3, 2)))
    moved = batch.get_states([1])[0]
    observations, info = batch.reset(options={"reset_mask": np.array([True, False, True])})
    assert np.array_equal(batch.get_states([0, 1, 2]), [start, moved, start])
    assert observations.shape == (3, 76)
    assert info["labels"].shape == (3, 6)
    batch.set_states([2], pond((15, 15, 0, 0), {RED: (15, 15, 0, 0)})[None])
    assert batch.step(np.zeros((3, 2)))[4]["labels"][:, 0].tolist() == [False, False, True]
    for indices in ([3], [-1], [0.5]):
        with pytest.raises(ValueError, match="row ind"):
            batch.set_states(indices, start[None])
    with pytest.raises(ValueError, match="differ"):
        batch.set_states([1, 1], np.stack([start, start]))
    with pytest.raises(ValueError, match="reset_mask"):
        batch.reset(options={"reset_mask": [True]})
    assert batch.set_states([], batch.get_states([])).shape == (0, 76)


def test_returned_arrays_are_not_reused() -> None:
    batch = WaterworldVectorEnv(2)
    results = [batch.step(np.ones((2, 2))) for _ in range(2)]
    states = [batch.get_states([0, 1]) for _ in range(2)]
    for first, second in [*zip(results[0][:4], results[1][:4], strict=True), states]:
        assert not np.shares_memory(first, second)
    assert not np.shares_memory(results[0][4]["labels"], results[1][4]["labels"])
    kept = states[0].copy()
    batch.step(np.ones((2, 2)))
    assert np.array_equal(states[0], kept)


def test_a_frame_shows_balls_in_their_colours_and_the_labels() -> None:
    env = WaterworldEnv(render_mode="rgb_array")
    env.set_state(pond((15, 15, 0, 0), {RED: (10, 20, 0, 0), 6: (20, 10, 0, 0)}))
    frame = env.render()
    assert frame is not None
    assert (frame.shape, frame.dtype) == ((540, 504, 3), np.uint8)
    red, blue, water = (
        frame[12 + 16 * row, 12 + 16 * column].astype(int) for column, row in ((10, 10), (20, 20), (5, 15))
    )
    assert red[0] > 2 * red[2]
    assert blue[2] > 2 * blue[0]
    assert water.min() > 150
    env.set_state(pond((15, 15, 0, 0), {RED: (15, 15, 0, 0)}))
    touching = env.render()
    assert touching is not None
    assert (touching[504:] != frame[504:]).any()
    frames = WaterworldVectorEnv(2, render_mode="rgb_array").render()
    assert frames is not None
    assert np.array_equal(frames[0], WaterworldEnv(render_mode="rgb_array").render())
    assert WaterworldEnv().render() is None
    assert WaterworldVectorEnv().render() is None
