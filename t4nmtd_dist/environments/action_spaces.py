"""Action spaces that agents support: Discrete, or a bounded real vector."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from t4nmtd_dist.core.agent_settings import agent_settings
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.core.errors import EnvError

Bounds = tuple[NDArray[np.float32], NDArray[np.float32]]


def check_action_space(task: TaskConfig, space: object) -> None:
    """Check that the task's learners support an action space.

    Raises:
        EnvError: if not; names the algorithm, the environment and the space.
    """
    name = task.learner.algorithm
    check = {"discrete": action_count, "continuous": action_bounds}[agent_settings(name).actions]
    check(space, task.environment.id, name.upper())


def action_count(space: object, environment: str, agent: str = "this agent") -> int:
    """Number of discrete actions; ``environment`` and ``agent`` are names for messages.

    Raises:
        EnvError: if the space is not Discrete.
    """
    if not isinstance(space, spaces.Discrete):
        raise EnvError(f"{agent} needs a Discrete action space; {environment} has {space}")
    return int(space.n)


def action_bounds(space: object, environment: str, agent: str = "this agent") -> Bounds:
    """Lowest and highest continuous actions, float32 [A]; arguments as for ``action_count``.

    Bounds that float32 cannot represent are rounded inwards.

    Raises:
        EnvError: if the space is not a one-dimensional Box of real numbers with finite bounds.
    """
    if not isinstance(space, spaces.Box):
        raise EnvError(f"{agent} needs a Box action space; {environment} has {space}")
    if len(space.shape) != 1 or space.dtype is None or space.dtype.kind != "f" or not space.is_bounded():
        raise EnvError(
            f"{agent} needs actions that are one vector of real numbers within finite bounds; {environment} has "
            f"{space} (wrappers such as gymnasium.wrappers.RescaleAction can help)"
        )
    return _inside(space.low, +np.inf), _inside(space.high, -np.inf)


def _inside(bound: NDArray[Any], inwards: float) -> NDArray[np.float32]:
    """The bound in float32, rounded inwards."""
    near: NDArray[np.float32] = bound.astype(np.float32)
    outside = near < bound if inwards > 0 else near > bound
    return np.where(outside, np.nextafter(near, np.float32(inwards)), near).astype(np.float32)
