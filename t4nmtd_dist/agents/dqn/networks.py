"""DQN's networks: Q and its target network Q'."""

from __future__ import annotations

import copy

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from t4nmtd_dist.agents.common.networks import load_weights, mlp, weights_of
from t4nmtd_dist.agents.common.peer_values import Values
from t4nmtd_dist.agents.weights import Arrays, Weights


class QNetworks(nn.Module):
    """Q, named ``actor`` because it acts, and Q', named ``target``, initially a copy of Q.

    Args:
        inputs: length of a product state.
    """

    def __init__(self, inputs: int, actions: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.actor = mlp(inputs, hidden, actions, last_gain=0.01)
        self.target = copy.deepcopy(self.actor).requires_grad_(requires_grad=False)


class MaxQCritic:
    """``common.published.Critic``: max_a Q'(s, a), on the CPU.

    Args:
        target: the network to copy.
    """

    def __init__(self, target: nn.Module) -> None:
        self._network = copy.deepcopy(target).cpu()

    @torch.no_grad()
    def values(self, states: NDArray[np.float32]) -> Values:
        """See ``Critic.values``; float32 [k]."""
        values: Values = self._network(torch.from_numpy(states)).amax(-1).numpy()
        return values

    def weights(self) -> Weights:
        """See ``Critic.weights``."""
        return weights_of(self._network)

    def load(self, weights: Arrays) -> None:
        """See ``Critic.load``."""
        load_weights(self._network, weights)
