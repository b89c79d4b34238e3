"""A continuous task: MuJoCo's two-joint arm visits three regions in order."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

REGIONS = {"a": (0.1, 0.14), "b": (-0.14, 0.1), "c": (-0.1, -0.14)}  # centres in metres; the arm is 0.21 m long
RADIUS = 0.06


class Fingertip(gymnasium.Wrapper[NDArray[np.float64], NDArray[np.float32], NDArray[np.float64], NDArray[np.float32]]):
    """Observes joints and fingertip instead of the registered target, and labels the regions the fingertip is in."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self.observation_space = gymnasium.spaces.Box(-10, 10, (8,))

    def reset(self, **options: Any) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Start with random joint angles."""
        self.env.reset(**options)
        arm: Any = self.env.unwrapped
        angles = np.concatenate([arm.np_random.uniform(-np.pi, np.pi, 1), arm.np_random.uniform(-2, 2, 1), [0.0, 0.0]])
        arm.set_state(angles, np.zeros(4))
        return self._seen(), {"labels": set()}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Act, and label the fingertip's regions."""
        _, reward, terminated, truncated, info = self.env.step(action)
        tip = self._tip()
        inside = {name for name, centre in REGIONS.items() if np.hypot(*(tip - centre)) < RADIUS}
        return self._seen(), float(reward), terminated, truncated, {**info, "labels": inside}

    def _tip(self) -> NDArray[np.float64]:
        position: NDArray[np.float64] = self.env.unwrapped.get_body_com("fingertip")[:2]  # type: ignore[attr-defined]
        return position

    def _seen(self) -> NDArray[np.float64]:
        data: Any = self.env.unwrapped.data  # type: ignore[attr-defined]
        angles, speeds = data.qpos[:2], data.qvel[:2]
        return np.clip(np.concatenate([np.cos(angles), np.sin(angles), speeds / 10, 5 * self._tip()]), -10, 10)


def make(render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
    """The arm without the registered time limit, which the task's horizon replaces."""
    return Fingertip(gymnasium.make("Reacher-v5", render_mode=render_mode).unwrapped)
