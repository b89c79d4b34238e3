"""A safety task: CartPole's pole must not fall, and its cart not leave the right half of the track."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

LEFT, TRACK, UPRIGHT = -0.5, 2.4, 0.2095  # metres, metres, radians


def make(render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
    """CartPole without its registered time limit, which the task's horizon replaces."""
    return gymnasium.make("CartPole-v1", render_mode=render_mode).unwrapped


def labels(observation: NDArray[np.float32], info: dict[str, Any]) -> set[str]:
    """The labels ``fallen`` and ``left`` after a step."""
    place, _, angle, _ = map(float, observation)
    found = {"fallen": abs(angle) > UPRIGHT or abs(place) > TRACK, "left": place < LEFT}
    return {name for name, holds in found.items() if holds}
