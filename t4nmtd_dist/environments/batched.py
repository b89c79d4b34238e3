"""The environment interface for learners: N environments with labels and exact snapshots.

All environments implement ``BatchedEnv``; ``environments.make_env`` opens them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.state_dict import State

Rows = NDArray[np.int64]
Observations = NDArray[np.float32]


@dataclass(frozen=True)
class EnvStep:
    """Result of one step of all N environments.

    Attributes:
        observations: float32 [N, d], after the step.
        labels: bool [N, P], true propositions in the order of ``propositions``.
        terminated: bool [N].
        truncated: bool [N], episodes cut by the environment, such as by a time limit.
    """

    observations: Observations
    labels: NDArray[np.bool_]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class BatchedEnv(Protocol):
    """N environments stepped together.

    Intended loop::

        observations = environment.reset(all_rows, seed)
        while True:
            step = environment.step(actions)
            observations[rows] = environment.restore(rows, states)      # rows that begin again
    """

    count: int
    propositions: tuple[str, ...]
    observation_size: int
    action_space: gym.Space[Any]
    categorical: NDArray[np.bool_]
    """Which numbers of an observation are one-hot, bool [d]."""

    @property
    def replayed(self) -> int:
        """Steps taken so far to restore states; they count as interactions."""

    def reset(self, rows: Rows, seed: int | None = None) -> Observations:
        """Reset some environments; float32 [len(rows), d]."""

    def restore(self, rows: Rows, states: Sequence[NDArray[Any]]) -> Observations:
        """Restore snapshots in some environments; float32 [len(rows), d]."""

    def snapshot(self, rows: Rows) -> list[NDArray[Any]]:
        """Snapshots of some environments, one flat array each."""

    def step(self, actions: NDArray[Any]) -> EnvStep:
        """Step every environment."""

    def state_dict(self) -> State:
        """Complete state of all environments, random generators included, for a checkpoint."""

    def load_state_dict(self, state: State) -> None:
        """Restore from the ``state_dict`` of as many environments."""
