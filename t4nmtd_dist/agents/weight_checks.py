"""Checks received weights against a task's networks: names, dtypes, shapes, finite values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from t4nmtd_dist.agents.common.normalisation import stored_normalisation
from t4nmtd_dist.agents.modules import shapes_module
from t4nmtd_dist.agents.weights import UPPER, Arrays, Shapes, networks_of
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.core.errors import PolicyError


@dataclass(frozen=True)
class NetworkSizes:
    """Network sizes that depend on the environment, not on the settings.

    Attributes:
        observation: length of an observation.
        action: number of discrete actions, or length of a continuous one.
    """

    observation: int
    action: int


def expected_shapes(config: TaskConfig, dfa_states: int, sizes: NetworkSizes) -> Shapes:
    """Names and shapes of all parameters of a task's learner.

    Raises:
        ConfigError: if the algorithm does not exist.
    """
    shapes = shapes_module(config.learner.algorithm)
    return shapes.parameter_shapes(config, sizes.observation + dfa_states, sizes.action)


def sizes_of(weights: Arrays, config: TaskConfig, dfa_states: int) -> NetworkSizes:
    """Infer the network sizes from weights, of several networks from the first.

    Raises:
        PolicyError: if they cannot be inferred.
        ConfigError: if the algorithm does not exist.
    """
    first, last = shapes_module(config.learner.algorithm).size_parameters(config.learner.hidden)
    own: Arrays = next((each for name, each in networks_of(weights).items() if name != UPPER), {})
    shape, end = (own[name].shape if name in own else () for name in (first, last))
    if len(shape) < 2 or not end:
        raise PolicyError(f"weights do not fit: {first} and {last} are expected, and are missing or of another shape")
    return NetworkSizes(shape[1] - dfa_states, end[0])


def check_weights(
    weights: Arrays, config: TaskConfig, dfa_states: int, sizes: NetworkSizes | None = None
) -> NetworkSizes:
    """Check a learner's weights against its task and, if given, the ``sizes`` of the task's other learners.

    Returns:
        The sizes.

    Raises:
        PolicyError: if the weights do not fit or are not finite; the message says which.
    """
    statistics, weights = stored_normalisation(weights)
    for name, own in networks_of(weights).items():
        if name == UPPER:
            check_shapes(own, {key: array.shape for key, array in own.items()})
        else:
            sizes = _check_network(own, config, dfa_states, sizes)
    if sizes is None:
        raise PolicyError("weights do not fit: there are none")
    goals = statistics is not None and any(networks_of(weights)) and statistics.size < sizes.observation
    if statistics is not None and statistics.size != sizes.observation and not goals:
        raise PolicyError(
            f"weights do not fit: statistics of {statistics.size} observed numbers, expected {sizes.observation}"
        )
    return sizes


def _check_network(own: Arrays, config: TaskConfig, dfa_states: int, sizes: NetworkSizes | None) -> NetworkSizes:
    found = sizes_of(own, config, dfa_states)
    if min(found.observation, found.action) < 1:
        raise PolicyError(f"weights do not fit: they are for observations of {found.observation} numbers")
    check_shapes(own, expected_shapes(config, dfa_states, sizes or found))
    return sizes or found


def check_alike(weights: Arrays, own: Arrays) -> None:
    """Check weights against those of the learner that will load them.

    Raises:
        PolicyError: if they do not fit or are not finite; the message says which.
    """
    theirs, weights = stored_normalisation(weights)
    ours, own = stored_normalisation(own)
    if (theirs is None) != (ours is None) or (theirs is not None and ours is not None and theirs.size != ours.size):
        raise PolicyError("weights do not fit: their statistics of observations are of other observations, or missing")
    check_shapes(weights, {name: array.shape for name, array in own.items()})


def check_shapes(weights: Arrays, expected: Shapes) -> None:
    """Check that weights are float32 and finite, and have the expected names and shapes.

    Raises:
        PolicyError: if not; the message says why.
    """
    missing = sorted(expected.keys() - weights.keys())
    unknown = sorted(weights.keys() - expected.keys())
    if missing or unknown:
        wrong = f"{missing[0]} is missing" if missing else f"{unknown[0]} is unknown"
        raise PolicyError(f"weights do not fit: {wrong}")
    for name, array in weights.items():
        if array.dtype != np.float32 or array.shape != expected[name]:
            raise PolicyError(
                f"weights do not fit: {name} is {array.dtype} {array.shape}, expected float32 {expected[name]}"
            )
        if not np.isfinite(array).all():
            raise PolicyError(f"weights are expected to be finite; {name} is not")
