"""DQN's actor, built from weights: greedy or epsilon-greedy."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.networks import mlp_of
from t4nmtd_dist.agents.weights import Weights

SAMPLED_EPSILON = 0.05


class GreedyActor:
    """The greedy action of Q, or an epsilon-greedy one.

    Samples with epsilon = 0.05, the learner's policy at the default ``epsilon_end``. A softmax over Q would depend on
    the reward scale.

    Raises:
        PolicyError: if parameters are missing or do not fit.
    """

    def __init__(self, hidden: tuple[int, ...], weights: Weights) -> None:
        self._network = mlp_of(weights, hidden)
        self.inputs = int(weights["0.weight"].shape[1])

    @torch.no_grad()
    def act(self, states: NDArray[np.float32], rng: np.random.Generator | None = None) -> NDArray[np.int64]:
        """See ``Actor.act``; epsilon-greedy with ``rng``."""
        q = self._network(torch.from_numpy(states))
        greedy: NDArray[np.int64] = q.argmax(-1).numpy()
        return greedy if rng is None else epsilon_greedy(greedy, q.shape[-1], SAMPLED_EPSILON, rng)


def epsilon_greedy(
    greedy: NDArray[np.int64], actions: int, epsilon: float, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Replace each greedy action [N] with a uniform one with probability ``epsilon``."""
    uniform = rng.integers(actions, size=len(greedy))
    return np.where(rng.random(len(greedy)) < epsilon, uniform, greedy)


def make_actor(hidden: tuple[int, ...], weights: Weights) -> GreedyActor:
    """See ``protocol.AgentActor``."""
    return GreedyActor(hidden, weights)
