"""SAC's actor, built from weights: mode or sample of a squashed Gaussian."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.action_bounds import scaled
from t4nmtd_dist.agents.sac.fast_cpu.forward import Activations, evaluate
from t4nmtd_dist.agents.sac.fast_cpu.squashed_gaussian import deterministic_actions, squashed_sample
from t4nmtd_dist.agents.sac.networks import Stack
from t4nmtd_dist.agents.sac.shapes import actor_shape
from t4nmtd_dist.agents.weights import Weights
from t4nmtd_dist.core.errors import PolicyError

Floats = NDArray[np.float32]


class GaussianActor:
    """Mode or sample of SAC's squashed Gaussian, scaled to the weights ``low`` and ``high``.

    Args:
        weights: of the actor, with the action bounds.

    Raises:
        PolicyError: if parameters are missing or do not fit.
    """

    def __init__(self, hidden: tuple[int, ...], weights: Weights) -> None:
        own = dict(weights)
        missing = [name for name in ("low", "high", "0.weight") if name not in own]
        if missing:
            raise PolicyError(f"an actor has no {missing[0]}; the export is damaged or of another format")
        self._low, self._high = own.pop("low"), own.pop("high")
        if self._low.ndim != 1 or self._low.shape != self._high.shape:
            raise PolicyError(f"an actor's low and high have shapes {self._low.shape} and {self._high.shape}")
        self.inputs = int(own["0.weight"].shape[1])
        self._stack = Stack(actor_shape(self.inputs, len(self._low), hidden))
        self._stack.load(own)

    @torch.no_grad()
    def act(self, states: Floats, rng: np.random.Generator | None = None) -> Floats:
        """See ``Actor.act``."""
        workspace = Activations(self._stack.shape, len(states))
        outputs = evaluate(self._stack.layers, torch.from_numpy(states), workspace)[0].numpy()
        if rng is None:
            return scaled(deterministic_actions(outputs).T, self._low, self._high)
        noise = rng.standard_normal((len(self._low), len(states)), np.float32)
        return scaled(squashed_sample(outputs, noise).actions.T, self._low, self._high)


def make_actor(hidden: tuple[int, ...], weights: Weights) -> GaussianActor:
    """See ``protocol.AgentActor``."""
    return GaussianActor(hidden, weights)
