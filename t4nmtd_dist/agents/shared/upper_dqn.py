"""The upper level of HRM and h-DQN: masked Double DQN over options (van Hasselt et al., 2016)."""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional

from t4nmtd_dist.agents.common.flat_adam import FlatAdam
from t4nmtd_dist.agents.common.networks import load_weights, mlp, mlp_of, weights_of
from t4nmtd_dist.agents.shared.decisions import Decisions
from t4nmtd_dist.agents.weights import Weights, part_of
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.method.options import ClosedOptions

Floats = NDArray[np.float32]
States = NDArray[np.int32]
ProductStates = Callable[[Floats, States], Floats]

HIDDEN = (64, 64)
LEARNING_RATE = 1e-3
BATCH = 32
CAPACITY = 50_000  # decisions
LEARNING_STARTS = 100  # decisions
TARGET_EVERY = 100  # updates
MAX_GRAD_NORM = 10.0


class UpperValues:
    """``OptionValues`` of trained weights, for evaluation and exported policies.

    Args:
        weights: of the network.
        states: product states of observations and DFA states.
    """

    def __init__(self, weights: Weights, states: ProductStates) -> None:
        self._network, self._states = mlp_of(weights, HIDDEN), states

    @torch.no_grad()
    def values(self, observations: Floats, q: States) -> Floats:
        """See ``UpperLearner.values``."""
        found: Floats = self._network(torch.from_numpy(self._states(observations, q))).numpy()
        return found


class UpperDQN:
    """``UpperLearner`` by a small Double DQN; one update per closed option.

    Args:
        inputs: length of a product state.
        options: R.
        reward_scale: reward factor.
        states: product states of observations and DFA states, as they are now.
        seed: of the initial weights.
        rng: draws batches.

    Attributes:
        gradient_steps: updates so far.
    """

    def __init__(
        self,
        inputs: int,
        options: int,
        reward_scale: float,
        states: ProductStates,
        seed: int,
        rng: np.random.Generator,
    ) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self._network = mlp(inputs, HIDDEN, options, last_gain=0.01)
        self._target = copy.deepcopy(self._network).requires_grad_(requires_grad=False)
        self._optimiser = FlatAdam.of_module(self._network, LEARNING_RATE)
        self._scale, self._states, self._rng = reward_scale, states, rng
        self._decisions = Decisions(CAPACITY)
        self.gradient_steps = 0

    @torch.no_grad()
    def values(self, observations: Floats, q: States) -> Floats:
        """See ``UpperLearner.values``."""
        found: Floats = self._network(torch.from_numpy(self._states(observations, q))).numpy()
        return found

    def learn(self, closed: ClosedOptions) -> None:
        """Store closed options, and make one update for each."""
        self._decisions.add(closed)
        if len(self._decisions) >= LEARNING_STARTS:
            for _ in range(len(closed.q)):
                self._update(self._decisions.draw(BATCH, self._rng))

    def _update(self, batch: ClosedOptions) -> None:
        states = torch.from_numpy(self._states(batch.observations, batch.q))
        taken = self._network(states).gather(1, torch.from_numpy(batch.choices)[:, None]).squeeze(1)
        loss = functional.smooth_l1_loss(taken, self.targets(batch))
        self._optimiser.gradient.zero_()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self._network.parameters(), MAX_GRAD_NORM)
        self._optimiser.step()
        self.gradient_steps += 1
        if self.gradient_steps % TARGET_EVERY == 0:
            self._target.load_state_dict(self._network.state_dict())

    @torch.no_grad()
    def targets(self, batch: ClosedOptions) -> torch.Tensor:
        """Scaled r + discount * Q'(s', argmax over the options available in s' of Q(s', .)) [B]."""
        next_states = torch.from_numpy(self._states(batch.next_observations, batch.q_next))
        masked = self._network(next_states).masked_fill(torch.from_numpy(~batch.mask), -torch.inf)
        follows = self._target(next_states).gather(1, masked.argmax(1, keepdim=True)).squeeze(1)
        rewards, discounts = (torch.from_numpy(each.astype(np.float32)) for each in (batch.rewards, batch.discounts))
        return self._scale * rewards + discounts * torch.where(discounts > 0, follows, 0.0)

    def weights(self) -> Weights:
        """Copies of the network's parameters, named ``actor.*``."""
        return {f"actor.{name}": array for name, array in weights_of(self._network).items()}

    def load(self, weights: Weights) -> None:
        """Load ``weights`` into network and target.

        Raises:
            PolicyError: if names or shapes differ.
        """
        load_weights(self._network, part_of(weights, "actor"))
        load_weights(self._target, part_of(weights, "actor"))

    def state_dict(self) -> State:
        """Networks, optimiser and decisions, for a checkpoint."""
        return {
            "network": weights_of(self._network),
            "target": weights_of(self._target),
            "optimiser": self._optimiser.state_dict(),
            "decisions": self._decisions.state_dict(),
            "gradient_steps": self.gradient_steps,
        }

    def load_state_dict(self, state: State) -> None:
        """Restore from ``state_dict``."""
        load_weights(self._network, state["network"])
        load_weights(self._target, state["target"])
        self._optimiser.load_state_dict(state["optimiser"])
        self._decisions.load_state_dict(state["decisions"])
        self.gradient_steps = state["gradient_steps"]
