"""What Waterworld shows: the features by hand, and that they foretell what commands will touch."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from ponds import colour_counts, command, commands, pond, run, snapshots

from envs.waterworld import WaterworldEnv


def features_of(colours: int, features: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    flags = 6 + 2 * colours
    return {
        "agent": features[:6],
        "due": features[6 : 6 + colours],
        "due_later": features[6 + colours : flags],
        "balls": features[flags:].reshape(colours, 3, 7),
    }


def test_features_as_computed_by_hand() -> None:
    env = WaterworldEnv()
    balls = {3: (10, 10, 2, 0), 4: (16, 12, -1, 1), 5: (18, 29, 0, 2)}
    seen = features_of(6, env.set_state(pond((14, 29, 1, 2), balls)))
    # The agent will be at (15, 30) after the coming step, where the upper wall ignores its y command and sends it back.
    np.testing.assert_allclose(seen["agent"], [-1 / 15, 14 / 15, 1 / 3.5, 2 / 3.5, 0, 1], atol=1e-6)
    # In two steps ball 5 has bounced to (18, 28), ball 4 is at (14, 14), ball 3 at (14, 10): in this order
    # the nearest, by the larger of both offsets from (15, 28). Only ball 5 can be touched there.
    np.testing.assert_allclose(
        seen["balls"][1],
        [
            [1, 3 / 4.5, 0, 4 / 240, 0, 0, 1 / 8],
            [0, 0, 0, 2 / 240, -17 / 240, -0.5 / 8, 0.5 / 8],
            [0, 0, 0, -4 / 240, -19 / 240, 1 / 8, 0],
        ],
        atol=1e-6,
    )
    assert not seen["due"].any()


@given(st.data(), colour_counts, commands)
@pytest.mark.slow
def test_flags_foretell_the_labels_of_the_next_two_steps(
    data: st.DataObject, colours: int, actions: list[tuple[float, float]]
) -> None:
    env = WaterworldEnv(colours=colours)
    seen = features_of(colours, env.set_state(data.draw(snapshots(colours))))
    foretold: list[list[float]] = [seen["due"].tolist(), seen["due_later"].tolist()]
    for number, action in enumerate(actions):
        observation, _, _, _, info = env.step(np.array(action))
        labels = [float(name in info["labels"]) for name in env.propositions]
        assert labels == foretold[number]
        foretold.append(features_of(colours, observation)["due_later"].tolist())


@pytest.mark.parametrize(("x", "within"), [(30, 0), (29, 0), (28, 1), (27, 1), (26, 1), (25, 0)])
def test_at_a_wall_only_what_the_reversed_velocity_comes_to_can_be_touched(x: float, within: int) -> None:
    env = WaterworldEnv()
    start = pond((29, 15, 3, 0), {0: (x, 15, 0, 0)})
    touches = set()
    for action in itertools.product(np.linspace(-3.5, 3.5, 8), repeat=2):
        seen = features_of(6, env.set_state(start))["balls"][0, 0]
        run(env, action, (0, 0))
        touches.add("red" in run(env, (0, 0))[1])
    assert seen[:3].tolist() == [within, 0, 0]
    assert any(touches) == bool(within)


@given(st.data(), st.integers(0, 17))
def test_some_command_touches_a_ball_that_is_said_to_be_within_reach(data: st.DataObject, slot: int) -> None:
    env = WaterworldEnv()
    start = data.draw(snapshots(6))
    seen = features_of(6, env.set_state(start))
    colour, place = divmod(slot, 3)
    within, *shown = seen["balls"][colour, place, :3].astype(np.float64)
    command = np.clip(4.5 * np.array(shown), -3.5, 3.5)
    run(env, (command[0], command[1]), (0, 0))
    assert within in (0.0, 1.0)
    if within:
        assert env.propositions[colour] in run(env, (0, 0))[1]
    else:
        assert shown == [0, 0]


@given(st.data(), colour_counts, st.tuples(command, command))
@pytest.mark.slow
def test_no_command_touches_a_colour_of_which_no_ball_is_within_reach(
    data: st.DataObject, colours: int, action: tuple[float, float]
) -> None:
    env = WaterworldEnv(colours=colours)
    seen = features_of(colours, env.set_state(data.draw(snapshots(colours))))
    beyond = {name for name, balls in zip(env.propositions, seen["balls"], strict=True) if not balls[:, 0].any()}
    run(env, action, (0, 0))
    assert not beyond & run(env, (0, 0))[1]
