"""Maps learners' continuous actions in [-1, 1] to the environment's bounds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def scaled(actions: NDArray[np.float32], low: NDArray[np.float32], high: NDArray[np.float32]) -> NDArray[np.float32]:
    """Scale actions [N, A] from [-1, 1] to [low, high], bounds included."""
    stretched: NDArray[np.float32] = np.clip((1 - actions) * (low / 2) + (1 + actions) * (high / 2), low, high)
    return stretched
