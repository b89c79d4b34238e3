"""Observations as networks see them: one-hot where they are categories, entries left out, and what cannot be used."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from own_environments import LEFT, LENGTH

from t4nmtd_dist.core.config import EnvironmentConfig
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.environments.make_env import make_env
from t4nmtd_dist.environments.observation_range import ObservationRange
from t4nmtd_dist.environments.observations import flattener
from t4nmtd_dist.tasks import load_task, task_names

HERE = str(Path(__file__).parent)
ONE = np.array([0])
MINIGRID = spaces.Dict(
    direction=spaces.Discrete(4), image=spaces.Box(0, 255, (7, 7, 3), np.uint8), mission=spaces.Text(80)
)


def environment(name: str, **settings: Any) -> EnvironmentConfig:
    return EnvironmentConfig(id=f"own_environments:{name}", horizon=30, path=HERE, **settings)


# One-hot


def test_several_categories_become_one_one_hot_each() -> None:
    flat = flattener(spaces.MultiDiscrete([2, 3]))
    assert flat.size == 5
    assert flat.flatten(np.array([1, 0])).tolist() == [0, 1, 1, 0, 0]
    assert flat.categorical.tolist() == [True] * 5


def test_small_whole_numbers_become_one_one_hot_each() -> None:
    flat = flattener(spaces.Box(np.array([-1, 0]), np.array([1, 11]), dtype=np.int64))
    assert flat.size == 3 + 12
    assert np.flatnonzero(flat.flatten(np.array([0, 11]))).tolist() == [1, 3 + 11]
    assert flat.categorical.all()


@given(data=st.data(), counts=st.lists(st.integers(1, 9), min_size=1, max_size=6))
def test_one_hots_tell_the_numbers_apart(data: st.DataObject, counts: list[int]) -> None:
    values = [data.draw(st.integers(0, count - 1)) for count in counts]
    for space in (
        spaces.MultiDiscrete(counts),
        spaces.Box(np.zeros(len(counts), np.int32), np.array(counts, np.int32) - 1, dtype=np.int32),
    ):
        rows = np.split(flattener(space).flatten(np.array(values)), np.cumsum(counts)[:-1])
        assert [int(row.argmax()) for row in rows] == values
        assert [row.sum() for row in rows] == [1] * len(counts)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(0, 255, (7, 7, 3), np.uint8),
        spaces.Box(0, 10, (7, 7, 3), np.uint8),  # 1617 numbers would be too many
        spaces.Box(0, 99, (2,), np.int64),
        spaces.Box(-(2**63), 2**63 - 1, (2,), np.int64),
        spaces.Box(0, 3, (2,), np.float32),
    ],
)
def test_pictures_and_large_numbers_stay_numbers(space: Any) -> None:
    flat = flattener(space)
    assert flat.size == int(np.prod(space.shape))
    assert not flat.categorical.any()
    assert flat.flatten(np.full(space.shape, 3)).tolist() == [3.0] * flat.size


@pytest.mark.parametrize("value", [[0, 12], [-1, 0], [0.5, 0]])
def test_a_number_that_its_space_does_not_hold_is_named(value: list[float]) -> None:
    flat = flattener(spaces.Dict(pos=spaces.Box(0, 11, (2,), np.int64)))
    with pytest.raises(EnvError, match=r"observation\['pos'\].*which is not in 0\.\.11"):
        flat.flatten({"pos": np.array(value)})


def test_a_wrong_number_of_numbers_is_named() -> None:
    with pytest.raises(EnvError, match=r"3 numbers.* expected 2"):
        flattener(spaces.MultiDiscrete([2, 3])).flatten(np.array([0, 1, 2]))


def test_a_dict_says_which_of_its_numbers_are_categories() -> None:
    flat = flattener(MINIGRID, leave_out=("mission",))
    assert flat.size == 4 + 147
    assert flat.categorical.tolist() == [True] * 4 + [False] * 147
    assert [part.name for part in flat.parts] == ["observation['direction']", "observation['image']"]


def test_the_packages_own_observations_are_numbers_as_ever() -> None:
    seen = {(str(task.environment.id), str(task.environment.options)): task for task in map(load_task, task_names())}
    for task in seen.values():
        for kind in ("features", "raw"):
            options = {**task.environment.options, "observation": kind}
            env = gymnasium.make(task.environment.id, **options)
            flat = flattener(env.observation_space)
            assert flat.size == int(np.prod(env.observation_space.shape or ()))
            assert not flat.categorical.any()


# Entries that are left out


def test_entries_that_cannot_be_used_are_named_with_how_to_leave_them_out() -> None:
    with pytest.raises(EnvError, match=r"observation\['mission'\] space Text.*leave_out = \[\"mission\"\]"):
        flattener(MINIGRID)
    two = spaces.Dict(a=spaces.Text(3), b=spaces.Discrete(2), c=spaces.Dict(d=spaces.Discrete(2)))
    with pytest.raises(EnvError, match=r"leave_out = \[\"a\", \"c\"\]"):
        flattener(two)


def test_the_labelling_function_sees_what_was_left_out() -> None:
    labels = "own_environments:missions_ends"
    env = make_env(environment("Missions", labels=labels, leave_out=("mission",)), 1, ("left", "right"))
    assert env.observation_size == 4 + 3 * LENGTH
    env.reset(ONE, 0)
    assert [env.step(np.array([LEFT])).labels[0].tolist() for _ in range(3)][-1] == [True, False]


@pytest.mark.parametrize(
    ("name", "left_out", "message"),
    [
        ("Missions", ("mission", "misson"), r"leave_out names 'misson'.*direction, image, mission"),
        ("Missions", ("mission", "image", "direction"), "leave_out leaves nothing"),
        ("Corridor", ("mission",), r"leave_out = \[\"mission\"\], but the observation is no Dict"),
    ],
)
def test_leaving_out_what_is_not_there_is_an_error(name: str, left_out: tuple[str, ...], message: str) -> None:
    with pytest.raises(EnvError, match=message):
        make_env(environment(name, leave_out=left_out), 1, ("left", "right"))


def test_the_packages_own_worlds_have_nothing_to_leave_out() -> None:
    config = load_task("task7", flags=['environment.leave_out=["mission"]']).environment
    with pytest.raises(EnvError, match="the observation is no Dict"):
        make_env(config, 1)


def test_too_many_categories_stay_numbers_and_are_warned_of() -> None:
    flat = flattener(spaces.MultiDiscrete([256] * 4))
    assert (flat.size, flat.categorical.any()) == (4, False)
    seen = ObservationRange(flat.parts)
    for value in (0, 255):
        seen.note(flat.flatten(np.full(4, value)))
    for normalised in (True, False):
        (text,) = seen.warnings(normalised=normalised)
        assert text.startswith("observation has 1024 categories, too many for one-hot (512)")
