"""PPO's networks for policy logits and state values."""

from __future__ import annotations

import copy

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from t4nmtd_dist.agents.common.networks import load_weights, mlp, weights_of
from t4nmtd_dist.agents.common.peer_values import Values
from t4nmtd_dist.agents.weights import Arrays, Weights


class ActorCritic(nn.Module):
    """Separate networks for policy logits and state values.

    Args:
        inputs: length of a product state.
    """

    def __init__(self, inputs: int, actions: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.actor = mlp(inputs, hidden, actions, last_gain=0.01)
        self.critic = mlp(inputs, hidden, 1, last_gain=1.0)

    def value(self, states: Tensor) -> Tensor:
        """State values [N] of product states [N, d + |Q|]."""
        return torch.as_tensor(self.critic(states)).squeeze(-1)


class ValueCritic:
    """``common.published.Critic``: V(s, q), on the CPU.

    Args:
        critic: the network to copy.
    """

    def __init__(self, critic: nn.Module) -> None:
        self._network = copy.deepcopy(critic).cpu()

    @torch.no_grad()
    def values(self, states: NDArray[np.float32]) -> Values:
        """See ``Critic.values``; float32 [k]."""
        values: Values = self._network(torch.from_numpy(states)).squeeze(-1).numpy()
        return values

    def weights(self) -> Weights:
        """See ``Critic.weights``."""
        return weights_of(self._network)

    def load(self, weights: Arrays) -> None:
        """See ``Critic.load``."""
        load_weights(self._network, weights)
