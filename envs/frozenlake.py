"""FrozenLake with passengers: N lakes in vectorised numpy, and a single one."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from envs.action_checks import checked_actions
from envs.batch_of_one import BatchOfOne
from envs.frozenlake_rules import (
    ACTIONS,
    ENDED,
    Observation,
    advance,
    checked_states,
    label_rows,
    lake_with,
    observation_space,
    observe,
)
from envs.snapshot_batch import Rows, SnapshotBatch


class FrozenLakeVectorEnv(SnapshotBatch):
    """N lakes as described in ``FrozenLakeEnv``; resets are deterministic."""

    metadata = {**SnapshotBatch.metadata, "render_fps": 4}  # noqa: RUF012 - gymnasium's own convention

    def __init__(
        self,
        num_envs: int = 1,
        goals: int = 1,
        observation: Observation = "features",
        render_mode: str | None = None,
    ) -> None:
        """Make ``num_envs`` lakes in their start state; other arguments as for ``FrozenLakeEnv``.

        Raises:
            ValueError: if an argument is invalid.
        """
        self.lake = lake_with(goals)
        self._actions = spaces.Discrete(len(ACTIONS))
        super().__init__(num_envs, self.lake.propositions, observation_space(observation), self._actions, render_mode)
        self._observation = observation
        self._states = np.tile(self.lake.start, (num_envs, 1))

    def _start(self, rows: Rows, seed: int | None) -> None:
        self._states[rows] = self.lake.start

    def _advance(self, actions: ArrayLike) -> NDArray[np.bool_]:
        advance(self.lake, self._states, checked_actions(self._actions, actions, self.num_envs))
        terminated: NDArray[np.bool_] = self._states[:, ENDED] != 0
        return terminated

    def _observe(self) -> NDArray[np.float32]:
        return observe(self._states, self._observation)

    def _labels(self) -> NDArray[np.bool_]:
        return label_rows(self.lake, self._states)

    def _snapshots(self, rows: Rows) -> NDArray[np.int32]:
        return self._states[rows].astype(np.int32)

    def _restore(self, rows: Rows, snapshots: NDArray[Any]) -> NDArray[np.float32]:
        restored = checked_states(self.lake, snapshots, rows.size)
        self._states[rows] = restored
        return observe(restored, self._observation)

    def _picture(self, row: int) -> NDArray[np.uint8]:
        from envs.frozenlake_drawing import render_lake

        return render_lake(self.lake, self._states[row])


class FrozenLakeEnv(BatchOfOne):
    """One lake; id ``t4nmtd/FrozenLake-v0``, contract in ``envs.protocol.SnapshotEnv``.

    Actions: 0 left, 1 down, 2 right, 3 up, 4 pick, 5 drop. Moves against the border have no effect. With empty hands,
    pick takes the passenger of the agent's cell; drop leaves the carried one on a cell without another.

    Labels: ``p1``, ``p2``, ``p3`` while carrying that passenger; ``g`` (or ``g1``, ``g2``) on the goal.

    Termination: entering a hole; with one goal also any move made on the goal cell. A terminated lake stays so,
    unchanged, until it is reset or restored.

    Observation ``"features"``, 83 numbers in [-1, 1]: one-hots of the agent's 64 cells (so that a small network does
    not smooth over holes) and of the hands (nobody, 1, 2, 3); per passenger its row and column (-1 to 1), its offset
    from the agent in rows and columns (by 7), and 1 if it can be picked. A carried passenger has the agent's position,
    offset 0, and cannot be picked. States with different futures have different observations.

    Observation ``"raw"``, the authors' 8 numbers: cell, carrying (0..3), and (row, column) of each passenger, (-1, -1)
    while carried.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012 - gymnasium's own convention

    def __init__(self, goals: int = 1, observation: Observation = "features", render_mode: str | None = None) -> None:
        """Make a lake in its start state.

        Args:
            goals: 1 for task 7, 2 for task 8.
            observation: "features" or "raw".
            render_mode: None or "rgb_array".

        Raises:
            ValueError: if an argument is invalid.
        """
        super().__init__(FrozenLakeVectorEnv(1, goals, observation, render_mode))
