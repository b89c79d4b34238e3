"""Product states: network inputs, an observation followed by the one-hot DFA state."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.environments.batched import Observations

Floats = NDArray[np.float32]
States = NDArray[np.int32]


def product_states(observations: Observations, q: NDArray[np.integer], dfa_states: int) -> Floats:
    """Network inputs, float32 [N, d + |Q|], from observations float32 [N, d] and DFA states [N]."""
    rows, size = observations.shape
    joined = np.zeros((rows, size + dfa_states), np.float32)
    joined[:, :size] = observations
    joined[np.arange(rows), size + q] = 1.0
    return joined


def with_goal(states: Floats, goal: int, length: int) -> Floats:
    """Product states [N, d + |Q|] followed by a one-hot goal of some ``length``."""
    joined = np.zeros((len(states), states.shape[1] + length), np.float32)
    joined[:, : states.shape[1]] = states
    joined[:, states.shape[1] + goal] = 1.0
    return joined
