"""A grid with random resets: a courier, a parcel, a door and a puddle on new cells every episode."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

SIDE = 6
MOVES = np.array([(0, 1), (1, 0), (0, -1), (-1, 0)])


class Courier(gymnasium.Env[NDArray[np.int64], int]):
    """Observes the row and column offsets of all objects, and the courier's cell: integers best encoded one-hot."""

    def __init__(self) -> None:
        offsets, cell = [2 * SIDE - 1] * 6, [SIDE] * 2
        self.observation_space: Any = gymnasium.spaces.MultiDiscrete(offsets + cell)
        self.action_space: Any = gymnasium.spaces.Discrete(len(MOVES))
        self.cells = np.zeros((4, 2), np.int64)  # courier, parcel, door, puddle: row and column

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[NDArray[np.int64], dict[str, Any]]:
        """Place all four on different cells."""
        super().reset(seed=seed)
        chosen = self.np_random.choice(SIDE * SIDE, 4, replace=False)
        self.cells = np.stack([chosen // SIDE, chosen % SIDE], axis=1)
        return self._seen(), self._info()

    def step(self, action: int) -> tuple[NDArray[np.int64], float, bool, bool, dict[str, Any]]:
        """Move one cell; walls block."""
        self.cells[0] = np.clip(self.cells[0] + MOVES[action], 0, SIDE - 1)
        return self._seen(), 0.0, False, False, self._info()

    def _seen(self) -> NDArray[np.int64]:
        offsets = self.cells[1:] - self.cells[0] + SIDE - 1
        return np.concatenate([offsets.ravel(), self.cells[0]])

    def _info(self) -> dict[str, Any]:
        on = (self.cells[1:] == self.cells[0]).all(axis=1)
        return {"labels": {name for name, holds in zip(("parcel", "door", "puddle"), on, strict=True) if holds}}
