"""FrozenLake with passengers: N lakes stepped by one set of numpy calls."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from envs.frozenlake import render_lake
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
from envs.protocol import checked_actions, checked_choice, checked_count, checked_indices, checked_reset_mask


class FrozenLakeVectorEnv(VectorEnv[NDArray[np.float32], NDArray[np.intp], NDArray[Any]]):
    """N lakes as described in ``FrozenLakeEnv``; contract in ``envs.protocol.SnapshotVectorEnv``.

    Rows never reset themselves. One that has terminated stays as it is and reports ``terminated`` until it is
    reset or set. Every returned array is fresh.
    """

    metadata = {  # noqa: RUF012 - gymnasium's own convention
        "render_modes": ["rgb_array"],
        "render_fps": 4,
        "autoreset_mode": AutoresetMode.DISABLED,
    }

    def __init__(
        self,
        num_envs: int = 1,
        goals: int = 1,
        observation: Observation = "features",
        render_mode: str | None = None,
    ) -> None:
        """Make N lakes in their start state.

        Args:
            num_envs: N, at least 1.
            goals: 1 for the lake of task 7, 2 for that of task 8.
            observation: "features" or "raw".
            render_mode: None or "rgb_array".

        Raises:
            ValueError: if an argument is none of these.
        """
        checked_choice("render_mode", render_mode, (None, "rgb_array"))
        self.lake = lake_with(goals)
        self.propositions: tuple[str, ...] = self.lake.propositions
        self.num_envs = checked_count(num_envs)
        self._actions = spaces.Discrete(len(ACTIONS))
        self.single_action_space = self._actions
        self.single_observation_space = observation_space(observation)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.render_mode = render_mode
        self._observation = observation
        self._states = np.tile(self.lake.start, (num_envs, 1))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Put rows back to the start; the same for every seed.

        Args:
            seed: seeds the (unused) random generator.
            options: ``{"reset_mask": bool [N]}`` resets only the rows where it is true.

        Returns:
            Observations [N, d] and ``{"labels": bool [N, P]}`` of all rows, reset or not.

        Raises:
            ValueError: if the mask is no bool array of shape (N,), or true nowhere.
        """
        super().reset(seed=seed)
        mask = (options or {}).get("reset_mask")
        rows = slice(None) if mask is None else checked_reset_mask(mask, self.num_envs)
        self._states[rows] = self.lake.start
        return observe(self._states, self._observation), self._info()

    def step(
        self, actions: ArrayLike
    ) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Take one action in every lake.

        Args:
            actions: integers 0..5 of shape (N,).

        Returns:
            Observations float32 [N, d], rewards float64 [N] of zero, terminated bool [N], truncated bool [N]
            of false, and ``{"labels": bool [N, P]}``.

        Raises:
            ValueError: if the actions are of another shape or type, or out of range; no lake has moved then.
        """
        advance(self.lake, self._states, checked_actions(self._actions, actions, self.num_envs))
        return (
            observe(self._states, self._observation),
            np.zeros(self.num_envs),
            self._states[:, ENDED] != 0,
            np.zeros(self.num_envs, dtype=np.bool_),
            self._info(),
        )

    def get_states(self, indices: ArrayLike) -> NDArray[np.int32]:
        """Snapshots of the rows ``indices`` [k]: int32 array of shape (k, 7), see ``envs.frozenlake_rules``.

        Raises:
            ValueError: if an index is not an integer in 0..N-1.
        """
        return self._states[checked_indices(indices, self.num_envs)].astype(np.int32)

    def set_states(self, indices: ArrayLike, states: NDArray[Any]) -> NDArray[np.float32]:
        """Restore snapshots (k, 7) into the rows ``indices`` [k]; returns their observations (k, d).

        Raises:
            ValueError: if an index is out of range or named twice, or a row of ``states`` is no snapshot of
                this lake; no row is changed then.
        """
        rows = checked_indices(indices, self.num_envs)
        if np.unique(rows).size != rows.size:
            raise ValueError(f"row indices must differ from each other, got {rows.tolist()}")
        restored = checked_states(self.lake, states, rows.size)
        self._states[rows] = restored
        return observe(restored, self._observation)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """One picture per lake, each uint8 of shape (420, 384, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        return tuple(render_lake(self.lake, state) for state in self._states)

    def _info(self) -> dict[str, Any]:
        return {"labels": label_rows(self.lake, self._states)}
