"""A custom environment and labelling function for Gymnasium's mountain car.

The car must climb the left hill, then reach the flag on the right one, and never touch the wall at the far left.
``mountain_car.toml`` beside this file is the task; docs/own-task.md explains both.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

STEPS_PER_ACTION = 6
LEFT_HILL, FLAG, WALL = -0.9, 0.5, -1.2


class HeldActions(gymnasium.Wrapper[NDArray[np.float32], int, NDArray[np.float32], int]):
    """Repeats every action for several steps, so that random actions make progress.

    ``info["leftmost"]`` is the car's leftmost position during them, so that no contact with the wall is missed.
    """

    def step(self, action: int) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Repeat the action for ``STEPS_PER_ACTION`` steps, or until the episode ends."""
        leftmost, total = np.inf, 0.0
        for _ in range(STEPS_PER_ACTION):
            observation, reward, terminated, truncated, info = self.env.step(action)
            leftmost, total = min(leftmost, float(observation[0])), total + float(reward)
            if terminated or truncated:
                break
        return observation, total, terminated, truncated, {**info, "leftmost": leftmost}


def make(render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
    """Gymnasium's mountain car with held actions, seen as two numbers in [-1, 1]: place and speed."""
    car = gymnasium.make("MountainCar-v0", render_mode=render_mode).unwrapped
    return gymnasium.wrappers.RescaleObservation(HeldActions(car), np.float32(-1), np.float32(1))


def labels(observation: NDArray[np.float32], info: dict[str, Any]) -> set[str]:
    """Which of ``left``, ``flag`` and ``wall`` hold after a step."""
    place = -1.2 + (float(observation[0]) + 1) / 2 * 1.8  # undo the scaling
    reached = {"left": place <= LEFT_HILL, "flag": place >= FLAG, "wall": info["leftmost"] <= WALL}
    return {name for name, holds in reached.items() if holds}


def play(path: str) -> bool:
    """Play one episode with the policy in ``path`` (a run or exported policy); returns whether it solved the task."""
    from t4nmtd_dist.policy import load

    policy, env = load(path), make()
    observation, _ = env.reset()
    solved, names = False, set[str]()
    for _ in range(policy.config.environment.horizon):
        observation, _, terminated, truncated, info = env.step(policy.act(observation, names))
        names, ended = labels(observation, info), terminated or truncated
        solved = policy.accepts(names, ended=ended)
        if solved or ended or policy.failed(names, ended=ended):
            break
    return solved
