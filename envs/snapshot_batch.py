"""Base of the batched environments: Gymnasium's vector interface, row selection and snapshots."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from envs.checks import checked_choice, checked_count, checked_distinct_indices, checked_indices, rows_to_reset

Rows = NDArray[np.intp]


class SnapshotBatch(VectorEnv[NDArray[np.float32], NDArray[Any], NDArray[Any]], ABC):
    """N environments stepped together; contract in ``envs.protocol.SnapshotVectorEnv``.

    Attributes:
        generators: one random generator per row; empty if the environment is deterministic.
    """

    metadata = {  # noqa: RUF012 - gymnasium's own convention
        "render_modes": ["rgb_array"],
        "autoreset_mode": AutoresetMode.DISABLED,
    }

    def __init__(
        self,
        num_envs: int,
        propositions: tuple[str, ...],
        observation_space: spaces.Box,
        action_space: spaces.Space[Any],
        render_mode: str | None,
    ) -> None:
        """Validate and store the common arguments; the spaces are those of one environment.

        Raises:
            ValueError: if ``num_envs`` or ``render_mode`` is invalid.
        """
        checked_choice("render_mode", render_mode, (None, "rgb_array"))
        self.num_envs = checked_count(num_envs)
        self.propositions = propositions
        self.single_observation_space, self.single_action_space = observation_space, action_space
        self.observation_space = batch_space(observation_space, num_envs)
        self.action_space = batch_space(action_space, num_envs)
        self.render_mode = render_mode
        self.generators: list[np.random.Generator] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Reset rows to the start.

        Args:
            seed: row i gets seed + i.
            options: ``{"reset_mask": bool [N]}`` selects the rows to reset.

        Returns:
            Observations [N, d] and ``{"labels": bool [N, P]}`` of all rows.

        Raises:
            ValueError: if the mask is not bool (N,), or all false.
        """
        super().reset(seed=seed)
        self._start(rows_to_reset(options, self.num_envs), seed)
        return self._observe(), {"labels": self._labels()}

    def step(
        self, actions: ArrayLike
    ) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Take one action in every row.

        Args:
            actions: of shape (N,) or (N, A).

        Returns:
            Observations float32 [N, d], rewards float64 [N] of zero, terminated bool [N], truncated bool [N] of false,
            and ``{"labels": bool [N, P]}``.

        Raises:
            ValueError: if the actions have the wrong shape or type, are NaN or out of bounds; no row moves then.
        """
        terminated = self._advance(actions)
        truncated = np.zeros(self.num_envs, dtype=np.bool_)
        return self._observe(), np.zeros(self.num_envs), terminated, truncated, {"labels": self._labels()}

    def get_states(self, indices: ArrayLike) -> NDArray[Any]:
        """Snapshots of the rows ``indices`` [k]: shape (k, s), defined in the environment's rules.

        Raises:
            ValueError: if an index is not an integer in 0..N-1.
        """
        return self._snapshots(checked_indices(indices, self.num_envs))

    def set_states(self, indices: ArrayLike, states: NDArray[Any]) -> NDArray[np.float32]:
        """Restore snapshots (k, s) into the rows ``indices`` [k]; returns their observations (k, d).

        Raises:
            ValueError: if an index is out of range or duplicate, or a snapshot is invalid; no row is changed then.
        """
        return self._restore(checked_distinct_indices(indices, self.num_envs), states)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """One frame per row, each uint8 [height, width, 3]; None without a render mode."""
        if self.render_mode is None:
            return None
        return tuple(self._picture(row) for row in range(self.num_envs))

    @abstractmethod
    def _start(self, rows: Rows, seed: int | None) -> None:
        """Reset ``rows`` to start states."""

    @abstractmethod
    def _advance(self, actions: ArrayLike) -> NDArray[np.bool_]:
        """Validate the actions and step every row; returns terminated, bool [N]."""

    @abstractmethod
    def _observe(self) -> NDArray[np.float32]:
        """Observations of all rows, a new array (N, d)."""

    @abstractmethod
    def _labels(self) -> NDArray[np.bool_]:
        """Labels of all rows, a new array (N, P)."""

    @abstractmethod
    def _snapshots(self, rows: Rows) -> NDArray[Any]:
        """Snapshots of ``rows``, a new array (k, s)."""

    @abstractmethod
    def _restore(self, rows: Rows, snapshots: NDArray[Any]) -> NDArray[np.float32]:
        """Validate snapshots (k, s), restore ``rows``, and return their observations (k, d)."""

    @abstractmethod
    def _picture(self, row: int) -> NDArray[np.uint8]:
        """Render one row."""
