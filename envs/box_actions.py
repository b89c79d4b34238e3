"""The check of actions from a symmetric box, for the environments with continuous actions."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

_ROUNDING = 1e-6  # relative; float32 has 6e-8


def symmetric_box(bound: float, size: int) -> spaces.Box:
    """The action space [-bound, bound]^size."""
    return spaces.Box(-bound, bound, (size,), np.float32)


def checked_box_actions(
    space: spaces.Box, bound: float, actions: ArrayLike, shape: tuple[int, ...]
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
