"""Observations as vectors: Box of any shape, Discrete as a one-hot, or a flat Dict of these."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from t4nmtd_dist.errors import WorldError

Vector = NDArray[np.float32]


@dataclass(frozen=True)
class Flattener:
    """Turns observations of one space into vectors.

    Attributes:
        size: length of the vectors.
        flatten: observation to float32 [size].
    """

    size: int
    flatten: Callable[[Any], Vector]


def flattener(space: gym.Space[Any]) -> Flattener:
    """How observations of ``space`` become vectors; the parts of a Dict come in its own order.

    Raises:
        WorldError: for any other space, by name.
    """
    if isinstance(space, spaces.Dict):
        parts = {key: _leaf(part, f"observation[{key!r}]") for key, part in space.spaces.items()}
        return Flattener(
            sum(part.size for part in parts.values()),
            lambda observation: np.concatenate([part.flatten(observation[key]) for key, part in parts.items()]),
        )
    return _leaf(space, "observation")


def _leaf(space: gym.Space[Any], what: str) -> Flattener:
    if isinstance(space, spaces.Box):
        return Flattener(int(np.prod(space.shape)), lambda value: np.asarray(value, np.float32).reshape(-1))
    if isinstance(space, spaces.Discrete):
        return _one_hot(int(space.n), int(space.start))
    raise WorldError(
        f"{what} space {space} is not supported; expected Box, Discrete, or a flat Dict of these "
        "(a wrapper such as gymnasium.wrappers.FlattenObservation can help)"
    )


def _one_hot(count: int, start: int) -> Flattener:
    rows = np.eye(count, dtype=np.float32)

    def flatten(value: Any) -> Vector:
        index = int(value) - start
        if not 0 <= index < count:
            raise WorldError(f"the environment observed {value!r}, which is not in {start}..{start + count - 1}")
        row: Vector = rows[index].copy()
        return row

    return Flattener(count, flatten)
