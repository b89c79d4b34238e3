"""A single environment as a batch of one, so that the rules of a world exist once."""

from __future__ import annotations

from itertools import compress
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from envs.action_checks import batch_of_one_action
from envs.snapshot_batch import SnapshotBatch

_ROW = np.zeros(1, dtype=np.intp)


class BatchOfOne(gymnasium.Env[NDArray[Any], Any]):
    """The only row of a batch, as a ``gymnasium.Env``; contract in ``envs.protocol.SnapshotEnv``."""

    def __init__(self, batch: SnapshotBatch) -> None:
        """Show a batch of one environment as a single one; its random generator is the ``np_random`` of this one."""
        self.propositions = batch.propositions
        self.observation_space, self.action_space = batch.single_observation_space, batch.single_action_space
        self.render_mode = batch.render_mode
        self._batch = batch

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Back to the start.

        Args:
            seed: decides whatever is random in the world.
            options: ignored.
        """
        super().reset(seed=seed)
        if self._batch.generators:
            self._batch.generators[0] = self.np_random
        observations, info = self._batch.reset()
        return observations[0], self._named(info)

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Take one action.

        Raises:
            ValueError: if ``action`` has another shape or type, holds NaN or is not in the action space.
        """
        actions = batch_of_one_action(self.action_space, action)
        observations, _, terminated, _, info = self._batch.step(actions)
        return observations[0], 0.0, bool(terminated[0]), False, self._named(info)

    def get_state(self) -> NDArray[Any]:
        """A snapshot: array of shape (s,), see the rules of the world."""
        snapshot: NDArray[Any] = self._batch.get_states(_ROW)[0]
        return snapshot

    def set_state(self, state: NDArray[Any]) -> NDArray[np.float32]:
        """Restore a snapshot; returns the observation there.

        Raises:
            ValueError: if ``state`` is no snapshot of this world; nothing changes then.
        """
        rows = state[None] if isinstance(state, np.ndarray) else state
        observation: NDArray[np.float32] = self._batch.set_states(_ROW, rows)[0]
        return observation

    def render(self) -> NDArray[np.uint8] | None:
        """The world and its labels, uint8 [height, width, 3]; None without a render mode."""
        pictures = self._batch.render()
        return None if pictures is None else pictures[0]

    def _named(self, info: dict[str, Any]) -> dict[str, Any]:
        return {"labels": frozenset(compress(self.propositions, info["labels"][0]))}
