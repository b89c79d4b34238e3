"""Waterworld: N ponds, moved by pymunk one by one and observed together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from envs.box_actions import checked_box_actions, symmetric_box
from envs.protocol import checked_choice, checked_count, checked_indices, checked_reset_mask
from envs.waterworld import render_pond, start_states
from envs.waterworld_maps import checked_map, palette_of
from envs.waterworld_ponds import Ponds
from envs.waterworld_rules import (
    TOP_COMMAND,
    Observation,
    checked_states,
    observation_space,
    observe,
    to_snapshots,
)


class WaterworldVectorEnv(VectorEnv[NDArray[np.float32], NDArray[Any], NDArray[Any]]):
    """N ponds as described in ``WaterworldEnv``; contract in ``envs.protocol.SnapshotVectorEnv``.

    No pond ever terminates. With ``map="random"`` each row has a generator of its own, and row i reset with
    seed s draws the maps of a single environment reset with s + i.
    """

    metadata = {  # noqa: RUF012 - gymnasium's own convention
        "render_modes": ["rgb_array"],
        "render_fps": 10,
        "autoreset_mode": AutoresetMode.DISABLED,
    }

    def __init__(
        self,
        num_envs: int = 1,
        colours: int = 6,
        map: int | str = "paper",
        observation: Observation = "features",
        render_mode: str | None = None,
    ) -> None:
        """Make N ponds in a start state.

        Args:
            num_envs: N, at least 1.
            colours: 6 (18 balls, task 1) or 8 (24 balls, task 2).
            map: "paper", a seed for a map that is drawn once, or "random" for a fresh map at every reset.
            observation: "features" or "raw".
            render_mode: None or "rgb_array".

        Raises:
            ValueError: if an argument is none of these.
        """
        checked_choice("render_mode", render_mode, (None, "rgb_array"))
        self.palette = palette_of(colours)
        self.propositions: tuple[str, ...] = self.palette.colours
        self.num_envs = checked_count(num_envs)
        self.single_action_space = self._commands = symmetric_box(TOP_COMMAND, 2)
        self.single_observation_space = observation_space(self.palette, observation)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.render_mode = render_mode
        self._map = checked_map(map)
        self._observation = observation
        self.generators = [np_random()[0] for _ in range(num_envs)]
        self._ponds = Ponds(self.palette, num_envs)
        self._start(range(num_envs))
        self._labels = self._ponds.touches()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Put rows back to the start.

        Args:
            seed: row i, if it is reset, gets seed + i for its random maps.
            options: ``{"reset_mask": bool [N]}`` resets only the rows where it is true.

        Returns:
            Observations [N, d] and ``{"labels": bool [N, P]}`` of all rows, reset or not.

        Raises:
            ValueError: if the mask is no bool array of shape (N,), or true nowhere.
        """
        super().reset(seed=seed)
        mask = (options or {}).get("reset_mask")
        everyone = np.ones(self.num_envs, dtype=np.bool_)
        chosen = everyone if mask is None else checked_reset_mask(mask, self.num_envs)
        rows = np.flatnonzero(chosen).tolist()
        if seed is not None:
            for row in rows:
                self.generators[row] = np_random(seed + row)[0]
        self._start(rows)
        self._labels = np.where(chosen[:, None], self._ponds.touches(), self._labels)
        return observe(self.palette, self._ponds.states, self._observation), self._info()

    def step(
        self, actions: ArrayLike
    ) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Command a velocity in every pond.

        Args:
            actions: numbers of shape (N, 2) within +-3.5.

        Returns:
            Observations float32 [N, d], rewards float64 [N] of zero, terminated and truncated bool [N] of
            false, and ``{"labels": bool [N, P]}``.

        Raises:
            ValueError: if the actions are of another shape or type, NaN or out of bounds; nothing has moved.
        """
        commands = checked_box_actions(self._commands, TOP_COMMAND, actions, (self.num_envs, 2))
        self._labels = self._ponds.step(commands)
        return (
            observe(self.palette, self._ponds.states, self._observation),
            np.zeros(self.num_envs),
            np.zeros(self.num_envs, dtype=np.bool_),
            np.zeros(self.num_envs, dtype=np.bool_),
            self._info(),
        )

    def get_states(self, indices: ArrayLike) -> NDArray[np.float64]:
        """Snapshots of the rows ``indices`` [k]: float64 array of shape (k, 76) or (k, 100).

        Raises:
            ValueError: if an index is not an integer in 0..N-1.
        """
        rows = checked_indices(indices, self.num_envs)
        return to_snapshots(self._ponds.states[:, rows])

    def set_states(self, indices: ArrayLike, states: NDArray[Any]) -> NDArray[np.float32]:
        """Restore snapshots (k, s) into the rows ``indices`` [k]; returns their observations (k, d).

        Raises:
            ValueError: if an index is out of range or named twice, or a row of ``states`` is no snapshot of
                a Waterworld with these colours; no row is changed then.
        """
        rows = checked_indices(indices, self.num_envs)
        if np.unique(rows).size != rows.size:
            raise ValueError(f"row indices must differ from each other, got {rows.tolist()}")
        restored = checked_states(self.palette, states, rows.size)
        self._ponds.put(rows.tolist(), restored)
        touches = self._ponds.touches()
        self._labels = self._labels.copy()
        self._labels[rows] = touches[rows]
        return observe(self.palette, restored, self._observation)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """One picture per pond, each uint8 of shape (540, 504, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        pictured = zip(self._ponds.states.swapaxes(0, 1), self._labels, strict=True)
        return tuple(render_pond(self.palette, state, labels) for state, labels in pictured)

    def _start(self, rows: Sequence[int]) -> None:
        generators = [self.generators[row] for row in rows]
        self._ponds.put(rows, start_states(self.palette, self._map, generators))

    def _info(self) -> dict[str, Any]:
        return {"labels": self._labels.copy()}
