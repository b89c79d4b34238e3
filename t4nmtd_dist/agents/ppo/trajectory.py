"""The rollout that one PPO update learns from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass
class Trajectory:
    """T steps of N environments; every array begins with the axes [T, N].

    Attributes:
        states: product states with normalised observations [T, N, d + |Q|].
        actions: action indices.
        log_probs: log pi(a|s) under the acting policy.
        rewards: scaled.
        terminal: F, E, or the environment terminated.
        cut: the DFA state changed or the attempt ended: GAE's trace stops here.
        boundary: cut and not terminal: s' needs its own bootstrap value.
        boundary_observations: raw s' before any restart [T, N, d].
        boundary_q: q' before any restart.
    """

    states: Floats
    actions: NDArray[np.int64]
    log_probs: Floats
    rewards: Floats
    terminal: Mask
    cut: Mask
    boundary: Mask
    boundary_observations: Floats
    boundary_q: NDArray[np.int32]

    @classmethod
    def empty(cls, steps: int, count: int, inputs: int, observation_size: int) -> Trajectory:
        """Allocate a trajectory, to be filled step by step."""
        shape = (steps, count)
        return cls(
            states=np.zeros((*shape, inputs), np.float32),
            actions=np.zeros(shape, np.int64),
            log_probs=np.zeros(shape, np.float32),
            rewards=np.zeros(shape, np.float32),
            terminal=np.zeros(shape, np.bool_),
            cut=np.zeros(shape, np.bool_),
            boundary=np.zeros(shape, np.bool_),
            boundary_observations=np.zeros((*shape, observation_size), np.float32),
            boundary_q=np.zeros(shape, np.int32),
        )
