"""PPO's actor, built from weights: the most likely or a sampled action."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from t4nmtd_dist.agents.common.networks import mlp_of
from t4nmtd_dist.agents.weights import Weights


class CategoricalActor:
    """The most likely action of PPO's categorical policy, or a sample.

    Raises:
        PolicyError: if parameters are missing or do not fit.
    """

    def __init__(self, hidden: tuple[int, ...], weights: Weights) -> None:
        self._network = mlp_of(weights, hidden)
        self.inputs = int(weights["0.weight"].shape[1])

    @torch.no_grad()
    def act(self, states: NDArray[np.float32], rng: np.random.Generator | None = None) -> NDArray[Any]:
        """See ``Actor.act``; samples by the Gumbel trick."""
        logits: Tensor = self._network(torch.from_numpy(states))
        if rng is None:
            return logits.argmax(-1).numpy()
        actions: NDArray[np.int64] = np.argmax(logits.numpy() + rng.gumbel(size=logits.shape), axis=1)
        return actions


def make_actor(hidden: tuple[int, ...], weights: Weights) -> CategoricalActor:
    """See ``protocol.AgentActor``."""
    return CategoricalActor(hidden, weights)
