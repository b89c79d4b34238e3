"""Which action spaces the learners can act in: Discrete for PPO, a bounded vector of real numbers for SAC."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.core.errors import EnvError

Bounds = tuple[NDArray[np.float32], NDArray[np.float32]]


def check_action_space(task: TaskConfig, space: object) -> None:
    """Check that the task's learners can act in a space.

    Raises:
        EnvError: if not; names the algorithm, the environment and the space.
    """
    if task.learner.algorithm == "ppo":
        action_count(space, task.environment.id)
    else:
        action_bounds(space, task.environment.id)


def action_count(space: object, environment: str) -> int:
    """How many actions PPO chooses from.

    Raises:
        EnvError: if the space is not Discrete.
    """
    if not isinstance(space, spaces.Discrete):
        raise EnvError(f"PPO needs a Discrete action space; {environment} has {space}")
    return int(space.n)


def action_bounds(space: object, environment: str) -> Bounds:
    """Lowest and highest actions of SAC, float32 [A]; where float32 is too coarse, inside the space.

    Raises:
        EnvError: if the space is not a Box of one dimension, of real numbers within finite bounds.
    """
    if not isinstance(space, spaces.Box):
        raise EnvError(f"SAC needs a Box action space; {environment} has {space}")
    if len(space.shape) != 1 or space.dtype is None or space.dtype.kind != "f" or not space.is_bounded():
        raise EnvError(
            f"SAC needs actions that are one vector of real numbers within finite bounds; {environment} has {space} "
            "(wrappers such as gymnasium.wrappers.RescaleAction can help)"
        )
    return _inside(space.low, +np.inf), _inside(space.high, -np.inf)


def _inside(bound: NDArray[Any], inwards: float) -> NDArray[np.float32]:
    """The bound in float32, moved inwards by one unit in the last place where rounding would lead outside."""
    near: NDArray[np.float32] = bound.astype(np.float32)
    outside = near < bound if inwards > 0 else near > bound
    return np.where(outside, np.nextafter(near, np.float32(inwards)), near).astype(np.float32)
