"""Weights as named numpy arrays, and how their names group them. Imports no torch."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import ProtocolError

Weights = dict[str, NDArray[Any]]
Arrays = Mapping[str, NDArray[Any]]
Shapes = dict[str, tuple[int, ...]]

NETWORK = ":"
UPPER = "upper"
"""Name of an upper level's network."""


def part_of(arrays: Arrays, part: str) -> Weights:
    """Arrays named ``part.*``, without that prefix."""
    prefix = part + "."
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def networks_of(weights: Arrays) -> dict[str, Weights]:
    """Weights by network: those named ``network:name`` without that prefix, and all others under the empty name.

    Only learners of methods whose roles share an environment hold several networks; see ``agents.shared``.
    """
    found: dict[str, Weights] = {}
    for name, array in weights.items():
        network, _, own = name.rpartition(NETWORK)
        found.setdefault(network, {})[own] = array
    return found


def of_network(network: str, weights: Arrays) -> Weights:
    """Weights named for ``networks_of``; the empty name changes nothing."""
    return {f"{network}{NETWORK}{name}" if network else name: array for name, array in weights.items()}


def acting_part(names: Iterable[str]) -> str:
    """The acting part of a learner's parameters: ``average`` if present, else ``actor``."""
    return "average" if any(name.startswith("average.") for name in names) else "actor"


def acting_parameters(weights: Arrays) -> Weights:
    """Parameters of the evaluated and exported actors (the averages, if kept), named ``actor.*``.

    Includes the observation statistics, if any, with every network.
    """
    statistics = {name: array for name, array in weights.items() if name.startswith("normalisation.")}
    acting: Weights = {}
    for network, own in networks_of(weights).items():
        kept = part_of(own, acting_part(own))
        if kept:
            acting |= of_network(network, {f"actor.{name}": array for name, array in (kept | statistics).items()})
    return acting


def check_finite(weights: Arrays) -> None:
    """Check received weights.

    Raises:
        ProtocolError: if they are not all finite.
    """
    for name, array in weights.items():
        if not np.isfinite(array).all():
            raise ProtocolError(f"weights are expected to be finite; {name} is not")


def mlp_shapes(part: str, inputs: int, hidden: Sequence[int], outputs: int) -> Shapes:
    """Names and shapes of the parameters of ``common.networks.mlp``, each name prefixed with ``part.``."""
    shapes: Shapes = {}
    for number, (width, out) in enumerate(pairwise([inputs, *hidden, outputs])):
        shapes[f"{part}.{2 * number}.weight"] = (out, width)
        shapes[f"{part}.{2 * number}.bias"] = (out,)
    return shapes
