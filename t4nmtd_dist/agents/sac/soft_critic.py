"""SAC's critic for peers: target critics and the actor whose actions they evaluate."""

from __future__ import annotations

import numpy as np
import torch

from t4nmtd_dist.agents.common.peer_values import Values
from t4nmtd_dist.agents.sac.fast_cpu.acting import FastActing
from t4nmtd_dist.agents.sac.networks import Stack, weights_of_stacks
from t4nmtd_dist.agents.sac.shapes import actor_shape, critics_shape
from t4nmtd_dist.agents.sac.updater import Floats, SACSettings
from t4nmtd_dist.agents.weights import Arrays, Weights, part_of


class SoftCritic:
    """``common.published.Critic``: (min_i Q'_i(s, a), log pi(a|s)), a sampled from the actor, on the CPU.

    Args:
        state_size: d, the length of a product state.
        action_size: A.
    """

    def __init__(self, state_size: int, action_size: int, settings: SACSettings, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)
        actor = actor_shape(state_size, action_size, settings.hidden)
        critics = critics_shape(state_size, action_size, settings.hidden, layer_norm=settings.layer_norm)
        self._actor, self._targets = Stack(actor, self.generator), Stack(critics, self.generator)
        self._acting = FastActing(self._actor, self._targets, self.generator)

    def values(self, states: Floats) -> Values:
        """See ``Critic.values``; float32 [k, 2]."""
        return np.stack(self._acting.soft_values(states), axis=1)

    def weights(self) -> Weights:
        """See ``Critic.weights``: ``actor.*`` and ``targets.*``."""
        return weights_of_stacks({"actor": self._actor, "targets": self._targets})

    def load(self, weights: Arrays) -> None:
        """See ``Critic.load``."""
        self._actor.load(part_of(weights, "actor"))
        self._targets.load(part_of(weights, "targets"))
