"""Continuous actions: learners act within [-1, 1], environments within their own bounds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def scaled(actions: NDArray[np.float32], low: NDArray[np.float32], high: NDArray[np.float32]) -> NDArray[np.float32]:
    """Actions [N, A] in [-1, 1] stretched to [low, high], both ends included."""
    stretched: NDArray[np.float32] = np.clip((1 - actions) * (low / 2) + (1 + actions) * (high / 2), low, high)
    return stretched
