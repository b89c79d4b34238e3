"""A single environment as a batch of one, so that rules exist only once."""

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
        """Wrap a batch of one environment; its random generator becomes this environment's ``np_random``."""
        self.propositions = batch.propositions
        self.observation_space, self.action_space = batch.single_observation_space, batch.single_action_space
        self.render_mode = batch.render_mode
        self._batch = batch

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Reset to the start; ignores ``options``."""
        super().reset(seed=seed)
        if self._batch.generators:
            self._batch.generators[0] = self.np_random
        observations, info = self._batch.reset()
        return observations[0], self._named(info)

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Take one action.

        Raises:
            ValueError: if ``action`` has the wrong shape or type, is NaN or not in the action space.
        """
        actions = batch_of_one_action(self.action_space, action)
        observations, _, terminated, _, info = self._batch.step(actions)
        return observations[0], 0.0, bool(terminated[0]), False, self._named(info)

    def get_state(self) -> NDArray[Any]:
        """A snapshot: array (s,), defined in the environment's rules."""
        snapshot: NDArray[Any] = self._batch.get_states(_ROW)[0]
        return snapshot

    def set_state(self, state: NDArray[Any]) -> NDArray[np.float32]:
        """Restore a snapshot; returns its observation.

        Raises:
            ValueError: if ``state`` is not a snapshot of this environment, which is then unchanged.
        """
        rows = state[None] if isinstance(state, np.ndarray) else state
        observation: NDArray[np.float32] = self._batch.set_states(_ROW, rows)[0]
        return observation

    def render(self) -> NDArray[np.uint8] | None:
        """The environment and its labels, uint8 [height, width, 3]; None without a render mode."""
        pictures = self._batch.render()
        return None if pictures is None else pictures[0]

    def _named(self, info: dict[str, Any]) -> dict[str, Any]:
        return {"labels": frozenset(compress(self.propositions, info["labels"][0]))}
