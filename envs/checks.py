"""Validates arguments of environments: keywords, row indices, reset masks and snapshots."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def checked_choice(keyword: str, value: object, choices: tuple[object, ...]) -> None:
    """Check the value of a constructor keyword.

    Raises:
        ValueError: if ``value`` is not one of ``choices``, with the same type.
    """
    if not any(type(value) is type(choice) and value == choice for choice in choices):
        expected = " or ".join(repr(choice) for choice in choices)
        raise ValueError(f"{keyword} must be {expected}, got {value!r}")


def checked_count(num_envs: object) -> int:
    """Validate the number of environments in a batch.

    Raises:
        ValueError: if it is not an integer of at least 1.
    """
    if type(num_envs) is not int or num_envs < 1:
        raise ValueError(f"num_envs must be an integer of at least 1, got {num_envs!r}")
    return num_envs


def checked_indices(indices: ArrayLike, num_envs: int) -> NDArray[np.intp]:
    """Validate row indices as intp (k,).

    Raises:
        ValueError: if they are not one-dimensional integers in 0..num_envs-1.
    """
    array = np.asarray(indices)
    if array.size == 0 and array.ndim == 1:
        return np.empty(0, dtype=np.intp)
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise ValueError(f"row indices must be integers of shape (k,), got {array.dtype} {array.shape}: {indices!r}")
    outside = (array < 0) | (array >= num_envs)
    if outside.any():
        raise ValueError(f"row index {array[outside][0]} is not in 0..{num_envs - 1}")
    return array.astype(np.intp, copy=False)


def checked_distinct_indices(indices: ArrayLike, num_envs: int) -> NDArray[np.intp]:
    """Validate distinct row indices as intp (k,).

    Raises:
        ValueError: see ``checked_indices``, and if a row occurs twice.
    """
    rows = checked_indices(indices, num_envs)
    if np.unique(rows).size != rows.size:
        raise ValueError(f"row indices must differ from each other, got {rows.tolist()}")
    return rows


def rows_to_reset(options: Mapping[str, Any] | None, num_envs: int) -> NDArray[np.intp]:
    """Row indices [k] selected by the option ``reset_mask`` of a batched reset, by default all.

    Raises:
        ValueError: if the mask is not a bool array of shape (num_envs,) or is all false, as in gymnasium's own vector
            environments.
    """
    mask = (options or {}).get("reset_mask")
    if mask is None:
        return np.arange(num_envs)
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (num_envs,):
        raise ValueError(f"options['reset_mask'] must be a bool array of shape ({num_envs},), got {mask!r}")
    if not mask.any():
        raise ValueError("options['reset_mask'] is true nowhere: expected at least one row to reset")
    return np.flatnonzero(mask)


def checked_snapshots(env: str, states: object, count: int, size: int, kind: str) -> NDArray[Any]:
    """Check that snapshots are a finite array (count, size), but not what its values mean.

    Args:
        env: name of the environment, for the message.
        states: the snapshots.
        count: number of snapshots.
        size: length of one snapshot.
        kind: allowed numpy kind codes, such as ``"i"`` or ``"f"``.

    Raises:
        ValueError: if they are not.
    """
    if not isinstance(states, np.ndarray) or states.dtype.kind not in kind or states.shape != (count, size):
        came = f"{states.dtype} {states.shape}" if isinstance(states, np.ndarray) else type(states).__name__
        raise ValueError(
            f"{env} expects {count} snapshot(s), an array of shape ({count}, {size}), dtype kind {kind!r}, "
            f"got {came}: {states!r}"
        )
    if states.dtype.kind == "f" and not np.isfinite(states).all():
        raise ValueError(f"a snapshot of {env} must be finite, got {states!r}")
    return states
