"""Environments as users write them, good and bad: a corridor of seven places with a label at either end."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

LENGTH = 7
LEFT, RIGHT = 0, 1


class Corridor(gymnasium.Env[Any, Any]):
    """Places 0 to 6, from 3; ``slip`` is the chance that a step goes nowhere."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012

    def __init__(self, slip: float = 0.0, render_mode: str | None = None) -> None:
        self.observation_space: Any = spaces.Discrete(LENGTH)
        self.action_space: Any = spaces.Discrete(2)
        self.slip, self.render_mode = slip, render_mode
        self.table = {place: (max(place - 1, 0), min(place + 1, LENGTH - 1)) for place in range(LENGTH)}
        self.visits = np.zeros(LENGTH, np.int64)
        self.last: int | None = None
        self.place = 3

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.place, self.last = 3, None
        self.visits[:] = 0
        return self.observe(), self.info()

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert isinstance(action, int)
        self.last = action
        if not self.slip or self.np_random.random() >= self.slip:
            self.place = self.table[self.place][action]
        self.visits[self.place] += 1
        return self.observe(), 0.0, bool(self.visits[self.place] >= 9), False, self.info()

    def observe(self) -> Any:
        return self.place

    def info(self) -> dict[str, Any]:
        names = {"left": self.place == 0, "right": self.place == LENGTH - 1, "again": self.visits.max() > 1}
        return {"labels": {name for name, holds in names.items() if holds}}

    def render(self) -> Any:
        picture = np.full((20, 20 * LENGTH, 3), 255, np.uint8)
        picture[:, 20 * self.place : 20 * self.place + 20] = (20, 90, 200)
        return picture


class Named(Corridor):
    """With ``get_state`` and ``set_state`` of its own, whatever they are made of."""

    def get_state(self) -> Any:
        return self.place, self.last, self.visits.copy()

    def set_state(self, state: Any) -> None:
        self.place, self.last, self.visits = state


class Forgetful(Named):
    """Its own ``set_state`` forgets the visits, which decide when an episode ends and what is labelled."""

    def set_state(self, state: Any) -> None:
        self.place, self.last, _ = state


class Engine:
    """Something from which no state can be read: no attributes, only calls."""

    __slots__ = ("_course",)

    def __init__(self) -> None:
        self._course = _course()
        next(self._course)

    def move(self, action: int) -> int:
        return self._course.send(action)


def _course() -> Iterator[int]:  # type: ignore[misc]
    place = 3
    while True:
        action = yield place
        place = min(max(place + 2 * action - 1, 0), LENGTH - 1)


class Opaque(Corridor):
    """Its place lives in an engine, as a simulator's would."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.engine = Engine()
        return super().reset(seed=seed)

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert isinstance(action, int)
        self.place = self.engine.move(action)
        return self.place, 0.0, False, False, self.info()


class Erratic(Corridor):
    """Takes its chance from where no seed reaches."""

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return super().step(os.urandom(1)[0] % 2)


class Mixed(Corridor):
    """Observes a Dict of a picture and two numbers."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        parts = {"picture": spaces.Box(0, 1, (2, LENGTH)), "last": spaces.Discrete(3, start=-1)}
        self.observation_space = spaces.Dict(parts)

    def observe(self) -> Any:
        picture = np.zeros((2, LENGTH), np.float32)
        picture[0, self.place] = 1
        return {"picture": picture, "last": -1 if self.last is None else self.last}


class Pairs(Corridor):
    """Observes a Tuple, which is not supported."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.observation_space = spaces.Tuple((spaces.Discrete(LENGTH), spaces.Discrete(2)))


def timed(steps: int = 8, render_mode: str | None = None) -> Any:
    """A corridor within a time limit: what a callable returns keeps its wrappers."""
    return gymnasium.wrappers.TimeLimit(Corridor(render_mode=render_mode), steps)


def undrawn(slip: float = 0.0) -> Any:
    """A corridor as users make it who have not thought of films."""
    return gymnasium.wrappers.TimeLimit(Corridor(slip), 30)


def always_drawn() -> Any:
    """A corridor that can always be drawn."""
    return gymnasium.wrappers.TimeLimit(Corridor(render_mode="rgb_array"), 30)


def handed_on(**options: Any) -> Any:
    """Whatever keywords come are the corridor's."""
    return gymnasium.wrappers.TimeLimit(Corridor(**options), 30)


def failing(**options: Any) -> Any:
    raise RuntimeError("no licence for the simulator")


def not_an_environment() -> Any:
    return object()


def ends(observation: int, info: dict[str, Any]) -> list[str]:
    """A labelling function that looks at the observation."""
    return [name for name, place in (("left", 0), ("right", LENGTH - 1)) if observation == place]


def undeclared(observation: int, info: dict[str, Any]) -> set[str]:
    return {"middle"}


def one_name(observation: int, info: dict[str, Any]) -> str:
    return "left"


def nothing(observation: int, info: dict[str, Any]) -> None:
    return None


def raising(observation: int, info: dict[str, Any]) -> set[str]:
    raise KeyError("speed")


def nothing_holds(observation: Any, info: dict[str, Any]) -> set[str]:
    return set()


class Offset(Corridor):
    """Observes its place as a number far from 0 and far too big: 500 + 100 a place."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.observation_space = spaces.Box(-np.inf, np.inf, (1,))

    def observe(self) -> Any:
        return np.array([500.0 + 100.0 * self.place], np.float32)


class Cells(Corridor):
    """Observes row and column as raw cell numbers; the grid is one row high."""

    def __init__(self, columns: int = LENGTH, kind: str = "int", **options: Any) -> None:
        super().__init__(**options)
        high, dtype = np.array([0, columns - 1]), np.int64 if kind == "int" else np.float32
        self.observation_space = spaces.Box(np.zeros(2, dtype), high.astype(dtype), dtype=dtype)  # type: ignore[arg-type]

    def observe(self) -> Any:
        return np.array([0, self.place], self.observation_space.dtype)


class Missions(Corridor):
    """Observes what MiniGrid's environments do: a direction, a picture of cell numbers, and a text."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.observation_space = spaces.Dict(
            direction=spaces.Discrete(4), image=spaces.Box(0, 255, (LENGTH, 1, 3), np.uint8), mission=spaces.Text(40)
        )

    def observe(self) -> Any:
        image = np.ones((LENGTH, 1, 3), np.uint8)
        image[self.place] = (10, 0, 0)
        return {"direction": self.last or 0, "image": image, "mission": "go left, then right"}


def missions_ends(observation: dict[str, Any], info: dict[str, Any]) -> list[str]:
    """A labelling function that needs the whole observation, the text too."""
    assert observation["mission"] == "go left, then right"
    return ends(int(observation["image"][:, 0, 0].argmax()), info)


class Pushed(Corridor):
    """Moved by a real number in [-1, 1], and observed as one far too big."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.action_space = spaces.Box(-1, 1, (1,))
        self.observation_space = spaces.Box(0, 1000, (1,))

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return super().step(int(action[0] > 0))

    def observe(self) -> Any:
        return np.array([1000 * self.place / (LENGTH - 1)], np.float32)


WAY = (RIGHT, RIGHT, RIGHT, LEFT, LEFT, LEFT)


class Winding(Offset):
    """The way turns in the middle, so that a policy must tell the places apart."""

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        super().reset(**options)
        self.place = 0
        return self.observe(), self.info()

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.place += int(self.place < len(WAY) and action == WAY[self.place])
        return self.observe(), 0.0, False, False, self.info()


class Wavering(Offset):
    """Its place as a large number that is not whole, without bounds."""

    def observe(self) -> Any:
        return np.array([500.5 + 100.25 * self.place], np.float32)
