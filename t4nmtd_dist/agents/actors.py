"""Actors rebuilt from exported weights: a categorical or a squashed Gaussian; the mode or a sample is taken of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from t4nmtd_dist.agents.common.networks import load_weights, mlp
from t4nmtd_dist.agents.common.normalisation import Normalisation, stored_normalisation
from t4nmtd_dist.agents.weights import Weights, acting_parameters, part_of
from t4nmtd_dist.core.config import LearnerConfig
from t4nmtd_dist.core.errors import PolicyError

Actions = NDArray[Any]


class Actor(Protocol):
    """Acts at product states."""

    inputs: int

    def act(self, states: Tensor, rng: np.random.Generator | None = None) -> Actions:
        """Actions of product states [N, inputs]: int64 [N], or float32 [N, A] within the action space's bounds.

        Args:
            states: product states.
            rng: the actions are drawn from the policy's distribution with it; without it they are the most likely ones.
        """


class CategoricalActor:
    """The actor of PPO: the most likely action, or one drawn from the categorical."""

    def __init__(self, hidden: tuple[int, ...], weights: Weights) -> None:
        names = (name for name in weights if name.endswith(".weight"))
        matrices = [weights[name] for name in sorted(names, key=lambda name: int(name.split(".")[0]))]
        if not matrices:
            raise PolicyError("an actor has no weights; the export is damaged or of another format")
        self.inputs = int(matrices[0].shape[1])
        self._network = mlp(self.inputs, hidden, matrices[-1].shape[0], last_gain=0.01)
        load_weights(self._network, weights)

    @torch.no_grad()
    def act(self, states: Tensor, rng: np.random.Generator | None = None) -> Actions:
        """See ``Actor.act``; sampling by the Gumbel trick."""
        logits: Tensor = self._network(states)
        if rng is None:
            return logits.argmax(-1).numpy()
        actions: Actions = np.argmax(logits.numpy() + rng.gumbel(size=logits.shape), axis=1)
        return actions


class GaussianActor:
    """The actor of SAC: the mode or a sample of its squashed Gaussian, scaled to the actions (``low``, ``high``)."""

    def __init__(self, hidden: tuple[int, ...], weights: Weights) -> None:
        from t4nmtd_dist.agents.sac.networks import Stack, StackShape

        own = dict(weights)
        missing = [name for name in ("low", "high", "0.weight") if name not in own]
        if missing:
            raise PolicyError(f"an actor has no {missing[0]}; the export is damaged or of another format")
        self._low, self._high = own.pop("low"), own.pop("high")
        if self._low.ndim != 1 or self._low.shape != self._high.shape:
            raise PolicyError(f"an actor's low and high have shapes {self._low.shape} and {self._high.shape}")
        self.inputs = int(own["0.weight"].shape[1])
        self._stack = Stack(StackShape(1, self.inputs, hidden, 2 * len(self._low), layer_norm=False))
        self._stack.load(own)

    @torch.no_grad()
    def act(self, states: Tensor, rng: np.random.Generator | None = None) -> Actions:
        """See ``Actor.act``."""
        from t4nmtd_dist.agents.common.squashed_gaussian import deterministic_actions, squashed_sample
        from t4nmtd_dist.agents.sac.networks import Activations, evaluate

        workspace = Activations(self._stack.shape, len(states))
        outputs = evaluate(self._stack.layers, states, workspace)[0].numpy()
        if rng is None:
            return scaled(deterministic_actions(outputs).T, self._low, self._high)
        noise = rng.standard_normal((len(self._low), len(states)), np.float32)
        return scaled(squashed_sample(outputs, noise).actions.T, self._low, self._high)


class NormalisingActor:
    """An actor that learned from normalised observations, and its statistics of them."""

    def __init__(self, actor: Actor, normalisation: Normalisation) -> None:
        if normalisation.size >= actor.inputs:
            raise PolicyError(
                f"an actor of {actor.inputs} inputs with statistics of {normalisation.size} observed numbers; expected "
                "fewer, since the DFA state comes after them"
            )
        self.inputs, self._actor, self._normalisation = actor.inputs, actor, normalisation

    def act(self, states: Tensor, rng: np.random.Generator | None = None) -> Actions:
        """See ``Actor.act``."""
        return self._actor.act(torch.from_numpy(self._normalisation.apply_to_states(states.numpy())), rng)


def scaled(actions: NDArray[np.float32], low: NDArray[np.float32], high: NDArray[np.float32]) -> NDArray[np.float32]:
    """Actions [N, A] in [-1, 1] stretched to [low, high], both ends included."""
    stretched: NDArray[np.float32] = np.clip((1 - actions) * (low / 2) + (1 + actions) * (high / 2), low, high)
    return stretched


def make_actor(config: LearnerConfig, weights: Mapping[str, NDArray[Any]]) -> Actor:
    """The actor of a learner's, or of an exported policy's, parameters.

    Raises:
        PolicyError: if they are missing or do not fit.
    """
    normalisation, own = stored_normalisation(part_of(acting_parameters(weights), "actor"))
    actor = GaussianActor(config.hidden, own) if config.algorithm == "sac" else CategoricalActor(config.hidden, own)
    return actor if normalisation is None else NormalisingActor(actor, normalisation)
