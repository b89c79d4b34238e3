"""Validates discrete actions and those of a symmetric Box."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

_ROUNDING = 1e-6  # relative; float32 has 6e-8


def symmetric_box(bound: float, size: int) -> spaces.Box:
    """The action space [-bound, bound]^size."""
    return spaces.Box(-bound, bound, (size,), np.float32)


def checked_action(space: spaces.Discrete, action: object) -> int:
    """Validate one discrete action as an int.

    Args:
        space: the action space, starting at 0.
        action: an int, a numpy integer or an integer array ().

    Raises:
        ValueError: if ``action`` has another type or is not in ``space``.
    """
    array = np.asarray(action)
    if array.shape != () or array.dtype.kind not in "iu" or not 0 <= int(array) < space.n:
        raise ValueError(f"action {action!r} is not in {space}: expected an integer from 0 to {space.n - 1}")
    return int(array)


def checked_actions(space: spaces.Discrete, actions: ArrayLike, num_envs: int) -> NDArray[np.intp]:
    """Validate a batch of discrete actions as intp (num_envs,).

    Args:
        space: action space of one environment, starting at 0.
        actions: integers, one per environment.
        num_envs: N.

    Raises:
        ValueError: if the shape or type is wrong or an action is not in ``space``.
    """
    array = np.asarray(actions)
    if array.shape != (num_envs,) or array.dtype.kind not in "iu":
        raise ValueError(
            f"actions must be integers of shape ({num_envs},) in {space}, "
            f"got {array.dtype} of shape {array.shape}: {actions!r}"
        )
    # As unsigned numbers, negative ones are huge, so one reduction checks both bounds.
    numbers = array.astype(np.intp, copy=False)
    if numbers.view(np.uintp).max() >= space.n:
        row = int(np.flatnonzero((numbers < 0) | (numbers >= space.n))[0])
        raise ValueError(f"action {array[row]} of row {row} is not in {space}")
    return numbers


def checked_box_actions(
    space: spaces.Box, bound: float, actions: object, shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """Validate actions as a new float64 array within [-bound, bound].

    Rounding errors up to a millionth of the bound are clipped.

    Args:
        space: action space of one environment, for the message.
        bound: its symmetric bound.
        actions: numbers.
        shape: the required shape.

    Raises:
        ValueError: if the type or shape is wrong, or a number is NaN or out of bounds.
    """
    array = np.asarray(actions)
    if array.shape != shape or array.dtype.kind not in "fiu":
        raise ValueError(
            f"expected numbers of shape {shape} in {space}, got {array.dtype} of shape {array.shape}: {actions!r}"
        )
    numbers = array.astype(np.float64)
    # The maximum is NaN if any number is, and then fails the comparison.
    largest = np.abs(numbers).max()
    if not largest <= bound * (1 + _ROUNDING):
        raise ValueError(f"action {actions!r} is not in {space}: every number must be within +-{bound}")
    return numbers if largest <= bound else numbers.clip(-bound, bound)


def batch_of_one_action(space: spaces.Space[Any], action: object) -> NDArray[Any]:
    """Validate one action as a batch of one, shape (1, ...).

    Args:
        space: Discrete, starting at 0, or a symmetric Box.
        action: one action.

    Raises:
        ValueError: if the type or shape is wrong, or the action is not in ``space``.
    """
    if isinstance(space, spaces.Discrete):
        return np.array([checked_action(space, action)])
    assert isinstance(space, spaces.Box)
    return checked_box_actions(space, float(space.high[0]), action, space.shape)[None]
