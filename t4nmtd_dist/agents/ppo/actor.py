"""PPO's actor rebuilt from weights: the most likely action, or one drawn from the categorical."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from t4nmtd_dist.agents.common.networks import load_weights, mlp
from t4nmtd_dist.agents.weights import Weights
from t4nmtd_dist.core.errors import PolicyError


class CategoricalActor:
    """The most likely action of PPO's categorical, or a sample of it.

    Args:
        hidden: widths of the hidden layers.
        weights: of the actor.

    Raises:
        PolicyError: if parameters are missing or do not fit.
    """

    def __init__(self, hidden: tuple[int, ...], weights: Weights) -> None:
        names = (name for name in weights if name.endswith(".weight"))
        matrices = [weights[name] for name in sorted(names, key=lambda name: int(name.split(".")[0]))]
        if not matrices:
            raise PolicyError("an actor has no weights; the export is damaged or of another format")
        self.inputs = int(matrices[0].shape[1])
        self._network = mlp(self.inputs, hidden, matrices[-1].shape[0], last_gain=0.01)
        load_weights(self._network, weights)

    @torch.no_grad()
    def act(self, states: NDArray[np.float32], rng: np.random.Generator | None = None) -> NDArray[Any]:
        """See ``Actor.act``; sampling by the Gumbel trick."""
        logits: Tensor = self._network(torch.from_numpy(states))
        if rng is None:
            return logits.argmax(-1).numpy()
        actions: NDArray[np.int64] = np.argmax(logits.numpy() + rng.gumbel(size=logits.shape), axis=1)
        return actions


def make_actor(hidden: tuple[int, ...], weights: Weights) -> CategoricalActor:
    """See ``protocol.AgentActor``."""
    return CategoricalActor(hidden, weights)
