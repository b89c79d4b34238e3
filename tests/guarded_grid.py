"""A small stochastic environment for tasks whose acceptance can be lost again: five by five cells with hazards."""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium import spaces

SIDE = 5
HAZARDS = {(0, 2), (1, 2), (4, 0), (4, 1), (3, 3)}
ALARMS = {(2, 2), (2, 1)}
GOAL = (0, 4)
STARTS = ((0, 0), (2, 0), (4, 4), (4, 3))
MOVES = ((0, 0), (0, -1), (1, 0), (0, 1), (-1, 0))  # stay, left, down, right, up
STAY = 0
SLIP = 0.02


class GuardedGrid(gymnasium.Env[int, int]):
    """One step in fifty goes a random way; attempts start in one of four cells.

    ``ends_at`` is a step on which the environment itself cuts the episode, 0 for none; ``fatal`` lets a hazard
    terminate it.
    """

    def __init__(self, ends_at: int = 0, fatal: bool = False) -> None:
        self.observation_space: Any = spaces.Discrete(SIDE * SIDE)
        self.action_space: Any = spaces.Discrete(len(MOVES))
        self.ends_at, self.fatal = ends_at, fatal
        self.row, self.column = STARTS[0]
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[int, dict[str, Any]]:
        """Start in a random one of the starting cells."""
        super().reset(seed=seed)
        self.row, self.column = STARTS[int(self.np_random.integers(len(STARTS)))]
        self.steps = 0
        return self.observe(), self.info()

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        """Stay, or go to a neighbouring cell; the border holds."""
        slips = self.np_random.random() < SLIP
        down, right = MOVES[int(self.np_random.integers(len(MOVES))) if slips else int(action)]
        self.row = min(max(self.row + down, 0), SIDE - 1)
        self.column = min(max(self.column + right, 0), SIDE - 1)
        self.steps += 1
        ended = self.fatal and (self.row, self.column) in HAZARDS
        return self.observe(), 0.0, ended, self.steps == self.ends_at, self.info()

    def observe(self) -> int:
        """The number of the cell."""
        return SIDE * self.row + self.column

    def info(self) -> dict[str, Any]:
        """What holds in this cell."""
        cell = (self.row, self.column)
        names = {"hazard": cell in HAZARDS, "alarm": cell in ALARMS, "goal": cell == GOAL}
        return {"labels": {name for name, holds in names.items() if holds}}
