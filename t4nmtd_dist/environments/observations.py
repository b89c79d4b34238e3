"""Flattens observations to vectors: Box, Discrete, MultiDiscrete, or a flat Dict of these.

Categories become one-hot: Discrete, MultiDiscrete, and integer Boxes with few values per entry. Other numbers are
unchanged.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import EnvError

Vector = NDArray[np.float32]

MOST_VALUES = 32
"""Of one integer of a Box that becomes one-hot: the cells of common grids, hardly the levels of a sensor."""
MOST_ONE_HOT = 512
"""Numbers that the integers of one Box or MultiDiscrete may become: a replay keeps each of them 300,000 times."""


@dataclass(frozen=True)
class Part:
    """The vector's part for a Dict entry, or the whole of another observation.

    Attributes:
        name: for messages: ``observation``, or ``observation['image']``.
        space: of the entry.
        size: length in the vector.
        one_hot: whether it is one-hot.
        flatten: entry to float32 [size].
    """

    name: str
    space: gym.Space[Any]
    size: int
    one_hot: bool
    flatten: Callable[[Any], Vector]


@dataclass(frozen=True)
class Flattener:
    """Converts observations of one space to vectors.

    Attributes:
        parts: in vector order.
        flatten: observation to float32 [size].
    """

    parts: tuple[Part, ...]
    flatten: Callable[[Any], Vector]

    @property
    def size(self) -> int:
        """Length of the vectors."""
        return sum(part.size for part in self.parts)

    @property
    def categorical(self) -> NDArray[np.bool_]:
        """Which vector entries are one-hot, bool [size]."""
        return np.repeat([part.one_hot for part in self.parts], [part.size for part in self.parts])


def flattener(space: gym.Space[Any], leave_out: Sequence[str] = ()) -> Flattener:
    """The flattener for observations of ``space``; keeps the order of a Dict, without the keys in ``leave_out``.

    Raises:
        EnvError: for any other space, and for unknown keys in ``leave_out``.
    """
    if isinstance(space, spaces.Dict):
        return _dict(space, leave_out)
    if leave_out:
        raise EnvError(f"{_setting(leave_out)}, but the observation is no Dict: {space}; remove that setting")
    part = _part(space, "observation")
    if part is None:
        raise EnvError(_refusal("observation", space))
    return Flattener((part,), part.flatten)


def _dict(space: spaces.Dict, leave_out: Sequence[str]) -> Flattener:
    strange = [key for key in leave_out if key not in space.spaces]
    if strange:
        raise EnvError(f"environment.leave_out names {strange[0]!r}; the observation has {', '.join(space.spaces)}")
    used = {key: entry for key, entry in space.spaces.items() if key not in leave_out}
    if not used:
        raise EnvError(f"{_setting(leave_out)}, and environment.leave_out leaves nothing to learn from")
    parts = {key: _part(entry, _entry(key)) for key, entry in used.items()}
    found = {key: part for key, part in parts.items() if part is not None}
    unusable = [key for key in parts if key not in found]
    if unusable:
        raise EnvError(
            f"{_refusal(_entry(unusable[0]), used[unusable[0]])}; where the task can do without it, leave it out: "
            f"{_setting([*leave_out, *unusable])}"
        )
    return Flattener(
        tuple(found.values()),
        lambda observation: np.concatenate([part.flatten(observation[key]) for key, part in found.items()]),
    )


def _entry(key: str) -> str:
    return f"observation[{key!r}]"


def _setting(keys: Sequence[str]) -> str:
    return f"environment.leave_out = {json.dumps(list(keys))}"


def _refusal(name: str, space: gym.Space[Any]) -> str:
    return (
        f"{name} space {space} is not supported; expected Box, Discrete, MultiDiscrete, or a flat Dict of these "
        "(a wrapper such as gymnasium.wrappers.FlattenObservation can help)"
    )


def _part(space: gym.Space[Any], name: str) -> Part | None:
    """The part for an entry; None if unsupported."""
    categories = _categories(space)
    if categories is not None:
        first, counts = categories
        return Part(name, space, int(counts.sum()), True, _one_hots(name, first, counts))
    if isinstance(space, spaces.Box | spaces.MultiDiscrete):
        size = int(np.prod(space.shape))
        return Part(name, space, size, False, lambda value: np.asarray(value, np.float32).reshape(-1))
    return None


def _categories(space: gym.Space[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
    """Lowest values and value counts, int64 [k] each, of integers that become one-hot, or None."""
    if isinstance(space, spaces.Discrete):
        return np.array([space.start], np.int64), np.array([space.n], np.int64)
    if isinstance(space, spaces.MultiDiscrete):
        counts = np.asarray(space.nvec, np.int64).reshape(-1)
        small = counts.sum() <= MOST_ONE_HOT
        return (np.asarray(space.start, np.int64).reshape(-1), counts) if small else None
    if isinstance(space, spaces.Box) and space.dtype is not None and space.dtype.kind in "iu" and space.shape:
        values = space.high.astype(np.float64) - space.low.astype(np.float64) + 1  # int64 could overflow
        if values.max() <= MOST_VALUES and values.sum() <= MOST_ONE_HOT:
            return space.low.astype(np.int64).reshape(-1), values.astype(np.int64).reshape(-1)
    return None


def _one_hots(name: str, first: NDArray[np.int64], counts: NDArray[np.int64]) -> Callable[[Any], Vector]:
    size, offsets = int(counts.sum()), np.cumsum(counts) - counts

    def flatten(value: Any) -> Vector:
        numbers = np.asarray(value).reshape(-1)
        if len(numbers) != len(counts):
            raise EnvError(f"the environment observed {len(numbers)} numbers in {name}; expected {len(counts)}")
        index = numbers - first
        wrong = np.flatnonzero((index < 0) | (index >= counts) | (index != np.floor(index)))
        if len(wrong):
            i = wrong[0]
            declared = f"{first[i]}..{first[i] + counts[i] - 1}"
            raise EnvError(
                f"the environment observed {numbers[i]} in {name}, which is not in {declared}, the whole numbers that "
                "its space declares; correct the space or the observation"
            )
        row: Vector = np.zeros(size, np.float32)
        row[offsets + index.astype(np.int64)] = 1.0
        return row

    return flatten
