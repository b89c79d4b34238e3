"""Racecar: motion, walls and quirks by hand, a second statement of the rules, snapshots, bad input."""

from __future__ import annotations

import itertools
import math
import warnings
from fractions import Fraction
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from envs.protocol import SnapshotEnv
from envs.racecar import RacecarEnv
from envs.racecar_track import OBSTACLE, Walls
from t4nmtd_dist.wire.codec import Envelope, decode, encode
from t4nmtd_dist.wire.messages import Release

GOALS = {"g1": (0.75, -0.75), "g2": (-0.75, -0.75), "g3": (0.75, 0.75), "g4": (-0.75, 0.75)}
CORNERS = [(1.5, 1.5), (-1.5, 1.5), (-1.5, -1.5), (1.5, -1.5)]
VERTICES = [(0.3 * math.cos(math.radians(10 * k)), 0.3 * math.sin(math.radians(10 * k))) for k in range(36)]

force = st.one_of(st.floats(-1, 1), st.sampled_from([-1.0, -0.5, 0.0, 0.5, 1.0]))
forces = st.lists(st.tuples(force, force), min_size=1, max_size=30)
inside = st.floats(-1.499, 1.499)
observations = st.sampled_from(["features", "raw"])


def snapshot(x: float, y: float, vx: float = 0.0, vy: float = 0.0, *rest: float) -> NDArray[np.float64]:
    return np.array([x, y, vx, vy, *(rest or [0.0] * 6)], dtype=np.float64)


@st.composite
def snapshots(draw: st.DrawFn) -> NDArray[np.float64]:
    """Any place on the track, often close to a wall, at any speed."""
    angle, gap = draw(st.floats(0, 6.3)), draw(st.floats(0, 0.06))
    near_obstacle = ((0.3 + gap) * math.cos(angle), (0.3 + gap) * math.sin(angle))
    x, y = draw(st.one_of(st.just(near_obstacle), st.tuples(inside, inside), st.tuples(st.just(1.49 - gap), inside)))
    assume(math.hypot(x, y) >= 0.3)
    speed = st.floats(-0.5, 0.5)
    return snapshot(x, y, draw(speed), draw(speed))


Exact = tuple[Fraction, Fraction]


def _orientation(a: Exact, b: Exact, c: Exact) -> Fraction:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _within(a: Exact, b: Exact, c: Exact) -> bool:
    return min(a[0], b[0]) <= c[0] <= max(a[0], b[0]) and min(a[1], b[1]) <= c[1] <= max(a[1], b[1])


def segments_meet(p: Exact, q: Exact, a: Exact, b: Exact) -> bool:
    """Whether two closed segments have a point in common, in exact arithmetic."""
    o1, o2, o3, o4 = _orientation(p, q, a), _orientation(p, q, b), _orientation(a, b, p), _orientation(a, b, q)
    if o1 * o2 < 0 and o3 * o4 < 0:
        return True
    ends = ((o1, p, q, a), (o2, p, q, b), (o3, a, b, p), (o4, a, b, q))
    return any(o == 0 and _within(*points) for o, *points in ends)


def meets_a_wall(old: tuple[float, float], new: tuple[float, float]) -> bool:
    """The rule of the specification with the walls' corners as rational numbers."""
    start, end = ((Fraction(x), Fraction(y)) for x, y in (old, new))
    for corners in (CORNERS, OBSTACLE):
        points = [(Fraction(x), Fraction(y)) for x, y in corners]
        if any(segments_meet(start, end, a, b) for a, b in zip(points, points[1:] + points[:1], strict=True)):
            return True
    return False


def wall_distance(x: float, y: float) -> float:
    """Distance to the nearest wall line, to leave out what rounding decides."""
    gaps = [1.5 - abs(x), 1.5 - abs(y)]
    for (ax, ay), (bx, by) in itertools.pairwise([*VERTICES, VERTICES[0]]):
        along = ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / ((bx - ax) ** 2 + (by - ay) ** 2)
        t = min(max(along, 0), 1)
        gaps.append(math.hypot(x - ax - t * (bx - ax), y - ay - t * (by - ay)))
    return min(abs(gap) for gap in gaps)


def reference_step(state: list[float], action: tuple[float, float]) -> tuple[list[float], set[str]]:
    """The specification once more: the next snapshot and the labels of the step."""
    position, velocity, hit_before = state[:2], state[2:4], state[9]
    distances = [math.dist(position, goal) for goal in GOALS.values()]
    labels = {name for name, distance in zip(GOALS, distances, strict=True) if distance <= 0.25}
    if hit_before:
        labels.add("wall")
    displacement = [v * 0.1 + a * 0.1**2 / 2 for v, a in zip(velocity, action, strict=True)]
    new = [p + d for p, d in zip(position, displacement, strict=True)]
    if meets_a_wall((position[0], position[1]), (new[0], new[1])):
        return [0.0, -0.7, 0.0, 0.0, *distances, hit_before, 1.0], labels
    faster = [min(max(v + a * 0.1, -0.5), 0.5) for v, a in zip(velocity, action, strict=True)]
    return [*new, *faster, *distances, hit_before, 0.0], labels


def run(env: RacecarEnv, *actions: tuple[float, float]) -> tuple[list[float], frozenset[str]]:
    """x, y, vx, vy and the labels after some steps."""
    info: dict[str, Any] = {}
    for action in actions:
        *_, info = env.step(np.array(action))
    return env.get_state()[:4].tolist(), info["labels"]


def over_the_wire(state: NDArray[np.float64]) -> NDArray[np.float64]:
    return decode(encode(Envelope(Release(pid="p1", epoch=1), {"state": state}))).arrays["state"]


def test_forces_move_the_car_by_newtons_law_up_to_the_top_speed() -> None:
    env = RacecarEnv()
    assert env.get_state()[:4].tolist() == [0, -0.7, 0, 0]
    assert run(env, (1, -0.5))[0] == pytest.approx([0.005, -0.7025, 0.1, -0.05])
    assert run(env, (0, 0))[0] == pytest.approx([0.015, -0.7075, 0.1, -0.05])  # no friction
    assert run(env, (1, 0))[0] == pytest.approx([0.03, -0.7125, 0.2, -0.05])
    env.set_state(snapshot(0.5, 0.5, 0.45, -0.5))
    # The displacement uses the full force, only the new velocity is clipped.
    assert run(env, (1, -1))[0] == pytest.approx([0.55, 0.445, 0.5, -0.5])


def test_quirk_a_wall_shows_in_the_labels_of_the_next_step() -> None:
    env = RacecarEnv()
    env.set_state(snapshot(1.48, 0, 0.3, 0.1))
    assert run(env, (0, 0)) == ([0, -0.7, 0, 0], set())
    assert run(env, (1, 0)) == (pytest.approx([0.005, -0.7, 0.1, 0]), {"wall"})
    assert run(env, (0, 0))[1] == set()


def test_quirk_targets_are_tested_on_the_position_before_the_move() -> None:
    env = RacecarEnv()
    env.set_state(snapshot(0.48, -0.75, 0.5, 0))
    assert run(env, (0, 0)) == (pytest.approx([0.53, -0.75, 0.5, 0]), set())
    assert run(env, (0, 0))[1] == {"g1"}
    env.set_state(snapshot(-1.0, 0.75, -0.5, 0))  # exactly on the border of g4, leaving
    assert run(env, (0, 0))[1] == {"g4"}
    assert run(env, (0, 0))[1] == set()


@pytest.mark.parametrize(("name", "place"), GOALS.items())
def test_each_target_has_its_name(name: str, place: tuple[float, float]) -> None:
    env = RacecarEnv()
    env.set_state(snapshot(*place))
    assert run(env, (0, 0))[1] == {name}


@pytest.mark.parametrize(
    ("start", "velocity"),
    [((1.47, 0.6), (0.5, 0)), ((-1.47, 0.6), (-0.5, 0)), ((0.6, 1.47), (0, 0.5)), ((0.6, -1.47), (0, -0.5))],
)
def test_every_outer_wall_sends_the_car_back(start: tuple[float, float], velocity: tuple[float, float]) -> None:
    env = RacecarEnv()
    env.set_state(snapshot(*start, *velocity))
    assert run(env, (0, 0))[0] == [0, -0.7, 0, 0]


def test_the_obstacle_is_a_polygon_with_a_vertex_at_angle_zero() -> None:
    # Across the middle of an edge the obstacle reaches 0.3 cos(5 degrees) = 0.29886, at vertices 0.3.
    walls = Walls()
    middle = (math.cos(math.radians(5)), math.sin(math.radians(5)))
    outside, between = (0.2995 * middle[0], 0.2995 * middle[1]), (0.2985 * middle[0], 0.2985 * middle[1])
    assert not walls.met((0.31 * middle[0], 0.31 * middle[1]), outside)
    assert walls.met(outside, between)
    assert walls.met((0.301, 0), (0.2999, 0))
    assert walls.met((0.2999, -0.02), (0.2999, 0.02))
    assert not walls.met((0.3001, -0.02), (0.3001, 0.02))


def test_a_move_that_ends_exactly_on_a_wall_meets_it() -> None:
    # Chipmunk's own query says no here, and no again to the next move, which goes on through the wall.
    walls = Walls()
    assert walls.met((1.45, 0.1), (1.5, 0.1))
    assert walls.met((0.1, -1.45), (0.1, -1.5))
    assert walls.met((1.49, 1.49), (1.5, 1.5))
    assert walls.met((0.35, 0), (0.3, 0))
    assert not walls.met((1.45, 0.1), (1.5 - 1e-11, 0.1))
    env = RacecarEnv()
    env.set_state(snapshot(1.475, 0.5, 0.25, 0))
    assert 1.475 + 0.25 * 0.1 == 1.5
    assert run(env, (0, 0))[0] == [0, -0.7, 0, 0]


@pytest.mark.parametrize("number", range(36))
def test_a_move_to_or_through_a_vertex_of_the_obstacle_meets_it(number: int) -> None:
    walls = Walls()
    x, y = OBSTACLE[number]
    assert (x, y) == pytest.approx(VERTICES[number])
    before, behind = (1.1 * x, 1.1 * y), (0.9 * x, 0.9 * y)
    assert walls.met(before, (x, y))
    assert walls.met(before, behind)
    tangent = [((x - t * y) * r, (y + t * x) * r) for r in (0.9999, 1.0001) for t in (-0.05, 0.05)]
    assert walls.met(tangent[0], tangent[1])
    assert not walls.met(tangent[2], tangent[3])


def test_straight_ahead_from_the_start_the_obstacle_is_met_at_a_vertex() -> None:
    # y = -0.7 + 0.005 + 0.015 + 0.025 + 0.035 + 0.045 + 5 * 0.055 = -0.3 after ten steps, exactly the vertex.
    env = RacecarEnv()
    assert run(env, *[(0, 1)] * 9)[0] == pytest.approx([0, -0.355, 0, 0.5])
    labels = [run(env, (0, 1))[1] for _ in range(3)]
    assert {"wall"} in labels
    assert env.get_state()[1] < -0.6


def test_corners_are_met_and_standing_still_meets_nothing() -> None:
    walls = Walls()
    assert walls.met((1.49, 1.49), (1.51, 1.51))
    assert walls.met((-1.49, 1.48), (-1.5, 1.5))
    assert not walls.met((0.0, -0.7), (0.0, -0.7))


@settings(max_examples=120)
@given(snapshots(), st.tuples(st.floats(-0.06, 0.06), st.floats(-0.06, 0.06)))
def test_walls_agree_with_exact_arithmetic(state: NDArray[np.float64], move: tuple[float, float]) -> None:
    x, y = state[:2].tolist()
    new = (x + move[0], y + move[1])
    assume(wall_distance(x, y) > 1e-9)
    assume(wall_distance(*new) > 1e-9)
    assert Walls().met((x, y), new) == meets_a_wall((x, y), new)


@settings(max_examples=60)
@given(snapshots(), forces)
@pytest.mark.slow
def test_every_step_follows_the_specification(state: NDArray[np.float64], actions: list[Any]) -> None:
    env = RacecarEnv()
    expected = state.tolist()
    env.set_state(state)
    for action in actions:
        assume(wall_distance(expected[0], expected[1]) > 1e-9)
        expected, labels = reference_step(expected, action)
        _, reward, terminated, truncated, info = env.step(np.array(action))
        assume(wall_distance(expected[0], expected[1]) > 1e-9)
        assert env.get_state().tolist() == pytest.approx(expected, abs=1e-12)
        assert (reward, terminated, truncated, info["labels"]) == (0.0, False, False, labels)
        expected = env.get_state().tolist()


@pytest.mark.slow
def test_ten_thousand_random_steps_stay_within_all_ranges_with_right_labels() -> None:
    raw, features = RacecarEnv(observation="raw"), RacecarEnv()
    actions = np.random.default_rng(0).uniform(-1, 1, (500, 2)).repeat(20, axis=0).astype(np.float32)
    seen: set[str] = set()
    hit = False
    for action in actions:
        position = raw.get_state()[:2]
        observation, _, _, _, info = raw.step(action)
        rich = features.step(action)[0]
        expected = {name for name, goal in GOALS.items() if math.dist(position, goal) <= 0.25}
        assert info["labels"] == expected | ({"wall"} if hit else set())
        assert raw.observation_space.contains(observation)
        assert features.observation_space.contains(rich)
        hit = bool(raw.get_state()[9])
        assert not hit or raw.get_state()[:4].tolist() == [0, -0.7, 0, 0]
        seen |= info["labels"]
    assert seen == {*GOALS, "wall"}


@settings(max_examples=60)
@given(snapshots(), observations, forces, forces)
def test_a_restored_snapshot_has_the_same_future_bit_for_bit(
    start: NDArray[np.float64], observation: Any, before: list[Any], after: list[Any]
) -> None:
    first = RacecarEnv(observation=observation)
    first.set_state(start)
    run(first, *before)
    here = first.step(np.zeros(2))[0]
    second = RacecarEnv(observation=observation)
    assert second.set_state(over_the_wire(first.get_state())).tobytes() == here.tobytes()
    for action in after:
        one, two = first.step(np.array(action)), second.step(np.array(action))
        assert one[0].tobytes() == two[0].tobytes()
        assert one[1:] == two[1:]
        assert first.get_state().tobytes() == second.get_state().tobytes()


def test_observations_as_computed_by_hand() -> None:
    raw = RacecarEnv(observation="raw")
    first, info = raw.reset(seed=1)
    assert first.tolist() == [0, np.float32(-0.7), 0, 0, 0, 0, 0, 0, 0]
    assert info["labels"] == set()
    # From (0.75, -0.25): 0.5 to g1, hypot(1.5, 0.5) to g2, 1 to g3, hypot(1.5, 1) to g4, before the move.
    raw.set_state(snapshot(0.75, -0.25, 0.5, 0))
    moved = raw.step(np.zeros(2))[0]
    distances = [0.5, math.sqrt(2.5), 1, math.sqrt(3.25)]
    np.testing.assert_allclose(moved, [0.8, -0.25, 0.5, 0, *distances, 0], atol=1e-6)
    raw.set_state(snapshot(1.49, 0, 0.5, 0))
    assert [raw.step(np.zeros(2))[0][8] for _ in range(3)] == [0, 1, 0]

    features = RacecarEnv().set_state(snapshot(0.6, -0.75, 0.5, -0.25, 0, 0, 0, 0, 0, 1))
    clearance = (math.hypot(0.6, 0.75) - 0.3) / 2
    np.testing.assert_allclose(features[:7], [0.4, -0.5, 1, -0.5, 0.5, clearance, 1], atol=1e-6)
    np.testing.assert_allclose(features[7:11], [0.15 / 2.25, 0, 0.15 / 3.2, 1], atol=1e-6)
    np.testing.assert_allclose(features[11:15], [-1.35 / 2.25, 0, 1.35 / 3.2, 0], atol=1e-6)


@pytest.mark.parametrize("observation", ["features", "raw"])
def test_gymnasiums_checker_is_content(observation: str) -> None:
    env = gymnasium.make("t4nmtd/Racecar-v0", observation=observation, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_the_world_is_registered_without_a_step_limit() -> None:
    env = gymnasium.make("t4nmtd/Racecar-v0")
    assert env.spec is not None
    assert env.spec.max_episode_steps is None
    assert isinstance(env.unwrapped, SnapshotEnv)
    assert env.unwrapped.propositions == ("g1", "g2", "g3", "g4", "wall")


@pytest.mark.parametrize("action", [[np.nan, 0], [0, 1.1], [-np.inf, 0], [0], [[0, 0]], "ab", None, 0.5])
def test_a_bad_action_is_refused_by_space_and_value(action: Any) -> None:
    env = RacecarEnv()
    with pytest.raises(ValueError, match=r"Box\(-1\.0, 1\.0, \(2,\), float32\)") as refused:
        env.step(action)
    assert repr(action) in str(refused.value)
    assert env.get_state()[:4].tolist() == [0, -0.7, 0, 0]


BAD_SNAPSHOTS = {
    "speed": snapshot(1, 1, 0.6, 0),
    "distance": snapshot(1.0, 1, 0, 0, -1, 0, 0, 0, 0, 0),
    "neither 0 nor 1": snapshot(1, 1, 0, 0, 0, 0, 0, 0, 0, 0.5),
    "not on the track": snapshot(1.5, 0),
    "is not on": snapshot(0.1, 0.1),
    "finite": snapshot(1.0, np.nan),
    r"Racecar.*\(1, 10\)": np.zeros(76),
    "dtype kind": np.zeros(10, dtype=int),
    "list": [0.0] * 10,
}


@pytest.mark.parametrize("reason", BAD_SNAPSHOTS)
def test_what_is_no_snapshot_is_refused_and_changes_nothing(reason: str) -> None:
    env = RacecarEnv()
    run(env, (1, 1))
    before = env.get_state()
    bad: Any = BAD_SNAPSHOTS[reason]
    with pytest.raises(ValueError, match=reason):
        env.set_state(bad)
    assert np.array_equal(env.get_state(), before)


@pytest.mark.parametrize("arguments", [{"observation": "pixels"}, {"render_mode": "human"}])
def test_bad_options_are_refused_by_name(arguments: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(arguments))):
        RacecarEnv(**arguments)


def test_a_frame_shows_walls_targets_car_and_labels() -> None:
    env = RacecarEnv(render_mode="rgb_array")
    frame = env.render()
    assert frame is not None
    assert (frame.shape, frame.dtype) == ((536, 500, 3), np.uint8)

    def at(x: float, y: float) -> NDArray[np.int64]:
        return frame[round(250 - y * 150), round(250 + x * 150)].astype(int)

    assert at(0, 0).max() < 100 < 200 < at(1, 0).min()  # obstacle and floor
    assert at(1.55, 0).max() < 100  # outer wall
    assert at(0.6, 0.6)[1] > at(0.6, 0.6)[0] + 20  # a green target
    env.set_state(snapshot(0.75, 0.75))
    in_target = env.render()
    assert in_target is not None
    assert (in_target[500:] != frame[500:]).any()
    assert RacecarEnv().render() is None
