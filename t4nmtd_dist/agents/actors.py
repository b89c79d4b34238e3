"""Builds actors from weights, for evaluation and exported policies. Imports torch lazily."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.normalisation import Normalisation, stored_normalisation
from t4nmtd_dist.agents.common.product_states import product_states
from t4nmtd_dist.agents.modules import actor_module
from t4nmtd_dist.agents.protocol import Actions, Actor
from t4nmtd_dist.agents.weights import Arrays, acting_parameters, part_of
from t4nmtd_dist.core.config import LearnerConfig
from t4nmtd_dist.core.errors import PolicyError

if TYPE_CHECKING:
    from t4nmtd_dist.agents.shared.upper_dqn import UpperValues


class NormalisingActor:
    """An actor trained on normalised observations, together with its observation statistics."""

    def __init__(self, actor: Actor, normalisation: Normalisation) -> None:
        if normalisation.size >= actor.inputs:
            raise PolicyError(
                f"an actor of {actor.inputs} inputs with statistics of {normalisation.size} observed numbers; expected "
                "fewer, since the DFA state comes after them"
            )
        self.inputs, self._actor, self._normalisation = actor.inputs, actor, normalisation

    def act(self, states: NDArray[np.float32], rng: np.random.Generator | None = None) -> Actions:
        """See ``Actor.act``."""
        return self._actor.act(self._normalisation.apply_to_states(states), rng)


def make_upper(weights: Arrays, dfa_states: int) -> UpperValues:
    """The values of an upper level's options, from its network's weights, named ``actor.*``.

    Raises:
        PolicyError: if parameters are missing or do not fit.
    """
    from t4nmtd_dist.agents.shared.upper_dqn import UpperValues  # imports torch

    normalisation, own = stored_normalisation(part_of(acting_parameters(weights), "actor"))

    def states(observations: NDArray[np.float32], q: NDArray[np.int32]) -> NDArray[np.float32]:
        seen = observations if normalisation is None else normalisation.apply(observations)
        return product_states(seen, q, dfa_states)

    return UpperValues(own, states)


def make_actor(config: LearnerConfig, weights: Arrays) -> Actor:
    """Build the actor of a learner or an exported policy.

    Raises:
        PolicyError: if parameters are missing or do not fit.
        ConfigError: if the algorithm does not exist.
    """
    normalisation, own = stored_normalisation(part_of(acting_parameters(weights), "actor"))
    actor = actor_module(config.algorithm).make_actor(config.hidden, own)
    return actor if normalisation is None else NormalisingActor(actor, normalisation)
