"""Replay of an upper level's decisions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.method.options import ClosedOptions


class Decisions:
    """A ring of closed options.

    Args:
        capacity: number of options kept.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._columns: dict[str, NDArray[Any]] = {}
        self._written = 0

    def __len__(self) -> int:
        return min(self._written, self._capacity)

    def add(self, closed: ClosedOptions) -> None:
        """Store options; at most ``capacity`` at once."""
        if not self._columns:
            self._columns = {
                name: np.zeros((self._capacity, *column.shape[1:]), column.dtype)
                for name, column in vars(closed).items()
            }
        rows = (self._written + np.arange(len(closed.q))) % self._capacity
        for name, column in vars(closed).items():
            self._columns[name][rows] = column
        self._written += len(rows)

    def draw(self, size: int, rng: np.random.Generator) -> ClosedOptions:
        """Draw options uniformly with replacement; there must be some."""
        rows = rng.integers(len(self), size=size)
        return ClosedOptions(**{name: column[rows] for name, column in self._columns.items()})

    def state_dict(self) -> dict[str, Any]:
        """Copies of the filled part, for a checkpoint."""
        filled = {name: column[: len(self)].copy() for name, column in self._columns.items()}
        return {"columns": filled, "written": self._written}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore from ``state_dict``."""
        self._columns, self._written = {}, 0
        if state["columns"]:
            self.add(ClosedOptions(**state["columns"]))
        self._written = state["written"]
