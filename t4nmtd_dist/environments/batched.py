"""Environments as the learners see them: N copies stepped together, with labels and exact snapshots.

Every environment keeps one contract, ``BatchedEnv``; ``environments.make_env`` opens one.
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
    """What one step of all N copies gave.

    Attributes:
        observations: float32 [N, d], after the step.
        labels: bool [N, P], the true propositions of each copy in the order of ``propositions``.
        terminated: bool [N], copies whose environment has ended.
        truncated: bool [N], copies whose environment cut the episode: a time-out, after which it cannot go on.
    """

    observations: Observations
    labels: NDArray[np.bool_]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class BatchedEnv(Protocol):
    """N copies of an environment.

    The loop it is meant for::

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
        """Steps taken so far only to restore states; they are interactions like any other."""

    def reset(self, rows: Rows, seed: int | None = None) -> Observations:
        """The environment's own reset of some copies; float32 [len(rows), d]."""

    def restore(self, rows: Rows, states: Sequence[NDArray[Any]]) -> Observations:
        """Put some copies into snapshots; float32 [len(rows), d]."""

    def snapshot(self, rows: Rows) -> list[NDArray[Any]]:
        """The states of some copies, one flat array each."""

    def step(self, actions: NDArray[Any]) -> EnvStep:
        """Step every copy."""

    def state_dict(self) -> State:
        """Everything that decides the future of all copies, random generators included, for a checkpoint."""

    def load_state_dict(self, state: State) -> None:
        """Go on from a ``state`` of an environment with as many copies."""
