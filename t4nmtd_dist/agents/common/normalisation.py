"""Running normalisation of observations to mean 0 and variance 1 before a learner's networks.

Every learner keeps statistics of its own attempts. Replay buffers, value queries and start states hold raw
observations.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.weights import Weights, part_of
from t4nmtd_dist.core.errors import PolicyError
from t4nmtd_dist.environments.batched import Observations

LIMIT = 10.0
"""What is further from the mean than so many standard deviations is cut off there."""
EPSILON = 1e-8
"""Added to variances: a number that never changes becomes 0."""

_PART = "normalisation"


class Normalisation:
    """Running mean and variance of every entry of an observation.

    Args:
        entries: which entries are normalised, bool [d]; the others, which are categorical, are unchanged.
    """

    def __init__(self, entries: NDArray[np.bool_]) -> None:
        self._entries = np.array(entries, np.bool_)
        self._count = 0.0
        self._mean = np.zeros(len(entries))
        self._squares = np.zeros(len(entries))
        self._refresh()

    @property
    def active(self) -> bool:
        """Whether any entry is normalised."""
        return bool(self._entries.any())

    @property
    def size(self) -> int:
        """Length of an observation, d."""
        return len(self._entries)

    def alike(self) -> Normalisation:
        """Empty statistics for the same observations."""
        return Normalisation(self._entries)

    def update(self, observations: Observations) -> None:
        """Add observations [N, d] (Chan, Golub and LeVeque, 1983)."""
        if not self.active:
            return
        seen = observations.astype(np.float64)
        count, mean = len(seen), seen.mean(axis=0)
        total, off = self._count + count, mean - self._mean
        self._squares += np.square(seen - mean).sum(axis=0) + np.square(off) * (self._count * count / total)
        self._mean += off * (count / total)
        self._count = total
        self._refresh()

    def _refresh(self) -> None:
        known = self._entries & (self._count > 0)
        variances = np.where(known, self._squares / max(self._count, 1.0), 1.0)
        self._shift = np.where(known, self._mean, 0.0)
        self._scale = np.where(known, 1.0 / np.sqrt(variances + EPSILON), 1.0)

    def apply(self, observations: Observations) -> Observations:
        """Normalised observations, float32 [N, d]; the input itself if not active."""
        if not self.active:
            return observations
        normal: Observations = np.clip((observations - self._shift) * self._scale, -LIMIT, LIMIT).astype(np.float32)
        return normal

    def apply_to_states(self, states: NDArray[np.float32]) -> NDArray[np.float32]:
        """Product states, float32 [N, d + |Q|], with normalised observations."""
        if not self.active:
            return states
        size = self.size
        return np.concatenate([self.apply(states[:, :size]), states[:, size:]], axis=1)

    def weights(self) -> Weights:
        """Copies of the statistics, named ``normalisation.*``, for a learner's weights; empty if not active."""
        if not self.active:
            return {}
        named = {
            "entries": self._entries.copy(),
            "count": np.array([self._count]),
            "mean": self._mean.copy(),
            "squares": self._squares.copy(),
        }
        return {f"{_PART}.{name}": array for name, array in named.items()}

    def load(self, weights: Mapping[str, NDArray[Any]]) -> Weights:
        """Load the statistics among a learner's weights; returns the other weights.

        Raises:
            PolicyError: if they are missing, damaged, or for other observations.
        """
        found = part_of(weights, _PART)
        if self.active or found:
            self._check(found)
            self._count = float(found["count"][0])
            self._mean, self._squares = np.array(found["mean"], np.float64), np.array(found["squares"], np.float64)
            self._refresh()
        return {name: array for name, array in weights.items() if not name.startswith(f"{_PART}.")}

    def _check(self, found: Mapping[str, NDArray[Any]]) -> None:
        size = self.size
        shapes = {"entries": (size,), "count": (1,), "mean": (size,), "squares": (size,)}
        if {name: array.shape for name, array in found.items()} != shapes:
            wanted = ", ".join(f"{name} {shape}" for name, shape in shapes.items()) if self.active else "none"
            came = ", ".join(f"{name} {array.shape}" for name, array in found.items()) or "none"
            raise PolicyError(f"weights with other statistics of observations: expected {wanted}; they have {came}")
        finite = all(np.isfinite(array).all() for array in found.values())
        if not finite or (found["squares"] < 0).any() or found["count"][0] < 0:
            raise PolicyError("weights with damaged statistics of observations: expected finite numbers from 0 up")
        if not np.array_equal(found["entries"], self._entries):
            raise PolicyError("weights with statistics of observations of which other numbers are normalised")


def stored_normalisation(weights: Mapping[str, NDArray[Any]]) -> tuple[Normalisation | None, Weights]:
    """The statistics among weights (None if there are none), and the other weights.

    Raises:
        PolicyError: if they are damaged.
    """
    entries = weights.get(f"{_PART}.entries", np.zeros(0, np.bool_))
    if entries.ndim != 1 or entries.dtype != np.bool_:
        raise PolicyError(f"weights with damaged statistics of observations: entries {entries.dtype} {entries.shape}")
    normalisation = Normalisation(entries)
    others = normalisation.load(weights)
    return (normalisation if normalisation.active else None), others
