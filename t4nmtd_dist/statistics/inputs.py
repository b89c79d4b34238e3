"""Checks of what the statistics are computed from; every message says what was expected and what came."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from t4nmtd_dist.core.errors import ConfigError

Floats: TypeAlias = NDArray[np.float64]
Bools: TypeAlias = NDArray[np.bool_]
RunsByTask: TypeAlias = Mapping[str, ArrayLike]
"""By name of the task: one number for each run, [runs]; tasks may differ in their number of runs."""


def vector(name: str, values: ArrayLike, low: float = -np.inf, high: float = np.inf, *, inf: bool = False) -> Floats:
    """A non-empty vector of numbers from ``low`` to ``high``, float64 [n].

    Args:
        name: what the error calls it.
        values: [n].
        low: least allowed number.
        high: greatest allowed number.
        inf: whether infinity, within low and high, is a number here.

    Raises:
        ConfigError: if it is not.
    """
    try:
        array = np.array(values, np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{name}: expected numbers, got {values!r}: {error}") from None
    if array.ndim != 1 or array.size == 0:
        raise ConfigError(f"{name}: expected a vector of at least one number, got an array of shape {array.shape}")
    bad = np.isnan(array) | (array < low) | (array > high)
    if not inf:
        bad |= np.isinf(array)
    if bad.any():
        first = int(bad.argmax())
        raise ConfigError(f"{name}: expected {_range(low, high, inf)}, got {array[first]:g} at index {first}")
    return array


def _range(low: float, high: float, inf: bool) -> str:
    kind = "numbers" if inf else "finite numbers"
    if np.isinf(low) and np.isinf(high):
        return kind
    if np.isinf(high):
        return f"{kind} of at least {low:g}"
    return f"{kind} from {low:g} to {high:g}"


def number(name: str, value: float, low: float, high: float) -> float:
    """A finite number strictly between ``low`` and ``high``.

    Raises:
        ConfigError: if it is not.
    """
    if not (np.isfinite(value) and low < value < high):
        above = "a finite number" if np.isinf(high) else f"a number below {high:g} and"
        raise ConfigError(f"{name}: expected {above} above {low:g}, got {value}")
    return float(value)


def whole(name: str, value: int, low: int, high: int | None = None) -> int:
    """A whole number from ``low`` to ``high``.

    Raises:
        ConfigError: if it is not.
    """
    if isinstance(value, bool) or not float(value).is_integer() or value < low or (high is not None and value > high):
        expected = f"of at least {low}" if high is None else f"from {low} to {high}"
        raise ConfigError(f"{name}: expected a whole number {expected}, got {value}")
    return int(value)


def same_length(**vectors: NDArray[np.generic]) -> None:
    """Check that all vectors have one length.

    Raises:
        ConfigError: if they do not.
    """
    if len({len(each) for each in vectors.values()}) > 1:
        lengths = ", ".join(f"{len(each)} {name}" for name, each in vectors.items())
        raise ConfigError(f"expected the same number of {' and '.join(vectors)}, got {lengths}")


def flags(name: str, values: ArrayLike) -> Bools:
    """A vector of booleans [n]; 0 and 1 count as such.

    Raises:
        ConfigError: if it is something else.
    """
    array = np.asarray(values)
    if array.ndim != 1 or not np.isin(array, (0, 1)).all():
        raise ConfigError(f"{name}: expected a vector of true and false, got {values!r}")
    return array.astype(np.bool_)


def by_task(
    name: str, runs: RunsByTask, low: float = -np.inf, high: float = np.inf, *, inf: bool = False
) -> dict[str, Floats]:
    """The checked numbers of at least one task, see :func:`vector`.

    Raises:
        ConfigError: if there is no task, or one has no runs or numbers out of range.
    """
    if not runs:
        raise ConfigError(f"{name}: expected the runs of at least one task, got none")
    return {task: vector(f"{name} of {task}", values, low, high, inf=inf) for task, values in runs.items()}


def same_tasks(a: Mapping[str, object], b: Mapping[str, object], names: str = "a and b") -> None:
    """Check that two mappings speak of the same tasks.

    Raises:
        ConfigError: if they do not.
    """
    if a.keys() != b.keys():
        raise ConfigError(f"{names}: expected the same tasks, got {sorted(a)} and {sorted(b)}")


def solving_times(name: str, times: RunsByTask, caps: Mapping[str, float]) -> dict[str, Floats]:
    """Interactions to solve by task, each from 0 to the task's cap, or infinity for a run that was not solved.

    Raises:
        ConfigError: if they are something else, or the tasks of ``caps`` are others.
    """
    same_tasks(times, caps, f"{name} and caps")
    runs = by_task(name, times, 0, inf=True)
    for task, each in runs.items():
        number(f"cap of {task}", caps[task], 0, np.inf)
        vector(f"{name} of {task}", np.where(np.isinf(each), 0, each), 0, caps[task])
    return runs
