"""Weights as named numpy arrays: which of them act, which belong together. Imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import ProtocolError

Weights = dict[str, NDArray[Any]]


def part_of(arrays: Mapping[str, NDArray[Any]], part: str) -> Weights:
    """The arrays named ``part.*``, without that prefix."""
    prefix = part + "."
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def acting_parameters(weights: Mapping[str, NDArray[Any]]) -> Weights:
    """The parameters, named ``actor.*``, of the actor that is evaluated and exported: the average, if there is one.

    If the learner normalises observations, its statistics are included.
    """
    kept = part_of(weights, "average") or part_of(weights, "actor")
    kept |= {name: array for name, array in weights.items() if name.startswith("normalisation.")}
    return {f"actor.{name}": array for name, array in kept.items()}


def check_finite(weights: Mapping[str, NDArray[Any]]) -> None:
    """Check weights that came from elsewhere.

    Raises:
        ProtocolError: if they are not all finite.
    """
    for name, array in weights.items():
        if not np.isfinite(array).all():
            raise ProtocolError(f"weights are expected to be finite; {name} is not")
