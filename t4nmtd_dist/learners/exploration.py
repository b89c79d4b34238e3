"""Exploration that is correlated in time, for learners that have not succeeded yet (docs/decisions/013)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Flags = NDArray[np.bool_]
FREQUENCIES = (0.05, 0.3)


class SinusoidExploration:
    """Some attempts are driven by sinusoids: per attempt one frequency (radians a step), per action a random phase.

    Args:
        count: copies of the world.
        action_size: A.
        share: share of the attempts of a learner without success that are driven so; it falls to 0 with success.
        rng: source of randomness.
    """

    def __init__(self, count: int, action_size: int, share: float, rng: np.random.Generator) -> None:
        self._share, self._rng = share, rng
        self._driven = np.zeros(count, np.bool_)
        self._frequency = np.zeros((count, 1))
        self._phase = np.zeros((count, action_size))
        self._time = np.zeros((count, 1))

    def begin(self, copies: Flags, success: float) -> None:
        """Decide for attempts that have just begun in ``copies`` whether they are driven."""
        rows = np.flatnonzero(copies)
        self._driven[rows] = self._rng.random(len(rows)) < self._share * (1.0 - success)
        self._frequency[rows] = self._rng.uniform(*FREQUENCIES, size=(len(rows), 1))
        self._phase[rows] = self._rng.uniform(0, 2 * np.pi, size=(len(rows), self._phase.shape[1]))
        self._time[rows] = 0

    def drive(self, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """The actions [N, A] in [-1, 1] to take: the policy's, or the sinusoid's in driven attempts."""
        waves = np.sin(self._frequency * self._time + self._phase)
        self._time += 1
        driven: NDArray[np.float32] = np.where(self._driven[:, None], waves, actions).astype(np.float32)
        return driven
