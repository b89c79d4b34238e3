"""Checks of actions: discrete ones, and those from a symmetric box."""

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
    """One discrete action as an int.

    Args:
        space: the action space, numbered from 0.
        action: an int, a numpy integer or an integer array of shape ().

    Raises:
        ValueError: if ``action`` is of another type or not in ``space``; names space and value.
    """
    array = np.asarray(action)
    if array.shape != () or array.dtype.kind not in "iu" or not 0 <= int(array) < space.n:
        raise ValueError(f"action {action!r} is not in {space}: expected an integer from 0 to {space.n - 1}")
    return int(array)


def checked_actions(space: spaces.Discrete, actions: ArrayLike, num_envs: int) -> NDArray[np.intp]:
    """The actions of a batch as an intp array of shape (num_envs,).

    Args:
        space: the action space of one environment, numbered from 0.
        actions: integers, one per environment.
        num_envs: N.

    Raises:
        ValueError: if the shape or type is wrong or an action is not in ``space``; names space and value.
    """
    array = np.asarray(actions)
    if array.shape != (num_envs,) or array.dtype.kind not in "iu":
        raise ValueError(
            f"actions must be integers of shape ({num_envs},) in {space}, "
            f"got {array.dtype} of shape {array.shape}: {actions!r}"
        )
    # Seen as unsigned numbers the negative ones are huge, so that one reduction checks both ends.
    numbers = array.astype(np.intp, copy=False)
    if numbers.view(np.uintp).max() >= space.n:
        row = int(np.flatnonzero((numbers < 0) | (numbers >= space.n))[0])
        raise ValueError(f"action {array[row]} of row {row} is not in {space}")
    return numbers


def checked_box_actions(
    space: spaces.Box, bound: float, actions: object, shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """Actions as a fresh float64 array within [-bound, bound].

    What lies outside by rounding alone (a millionth of the bound) is moved onto the bound.

    Args:
        space: the action space of one environment, for the message.
        bound: its symmetric bound.
        actions: numbers.
        shape: the shape that they must have.

    Raises:
        ValueError: if type or shape are wrong, or a number is NaN or outside; names space and value.
    """
    array = np.asarray(actions)
    if array.shape != shape or array.dtype.kind not in "fiu":
        raise ValueError(
            f"expected numbers of shape {shape} in {space}, got {array.dtype} of shape {array.shape}: {actions!r}"
        )
    numbers = array.astype(np.float64)
    # The largest magnitude is NaN if one of the numbers is, and then not within the limit.
    largest = np.abs(numbers).max()
    if not largest <= bound * (1 + _ROUNDING):
        raise ValueError(f"action {actions!r} is not in {space}: every number must be within +-{bound}")
    return numbers if largest <= bound else numbers.clip(-bound, bound)


def batch_of_one_action(space: spaces.Space[Any], action: object) -> NDArray[Any]:
    """One action of an environment as the actions of a batch of one, shape (1, ...).

    Args:
        space: Discrete, numbered from 0, or a symmetric Box.
        action: one action.

    Raises:
        ValueError: if type or shape are wrong, or the action is not in ``space``; names space and value.
    """
    if isinstance(space, spaces.Discrete):
        return np.array([checked_action(space, action)])
    assert isinstance(space, spaces.Box)
    return checked_box_actions(space, float(space.high[0]), action, space.shape)[None]
