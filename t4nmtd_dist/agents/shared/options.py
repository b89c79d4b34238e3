"""What the learner of an option method does for the upper level."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.context import AgentContext
from t4nmtd_dist.agents.common.rollout import RolloutStep
from t4nmtd_dist.agents.shared.upper_dqn import ProductStates, UpperDQN
from t4nmtd_dist.agents.weights import Weights
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.environments.batched import Observations
from t4nmtd_dist.method.options import OptionMethod

Rows = NDArray[np.int64]
States = NDArray[np.int32]


class OptionsInProgress:
    """The options that N copies follow, and the upper level that learns from them.

    Args:
        method: gets the upper level.
        context: sizes and settings.
        count: N.
        states: product states of observations and DFA states.
        seed: of the upper level's network.
        rng: random generator.
    """

    def __init__(
        self,
        method: OptionMethod,
        context: AgentContext,
        count: int,
        states: ProductStates,
        seed: int,
        rng: np.random.Generator,
    ) -> None:
        self._method = method
        inputs = context.observation_size + context.dfa_states
        self._upper = UpperDQN(inputs, len(method.roles), context.settings.reward_scale, states, seed, rng)
        method.upper = self._upper
        self._open = method.open_options(count, context.observation_size)

    @property
    def gradient_steps(self) -> int:
        """Updates of the upper level."""
        return self._upper.gradient_steps

    def open(self, rows: Rows, observations: Observations, q: States, roles: States) -> None:
        """Begin options ``roles`` [k] in ``rows`` [k]."""
        self._open.open(rows, observations, q, [self._method.roles[number] for number in roles])

    def after_step(self, roles: States, q: States, step: RolloutStep, over: Rows) -> None:
        """Pay for a step of all copies, and learn from the options that are over."""
        rewards = np.zeros(len(q))
        for number in np.unique(roles):
            rows = roles == number
            rewards[rows] = self._method.upper_rewards(
                self._method.roles[number], q[rows], step.q_next[rows], step.terminated[rows]
            )
        self._open.earn(rewards)
        if len(over):
            closed = self._open.close(over, step.next_observations[over], step.q_next[over], step.terminal[over])
            self._upper.learn(closed)

    def weights(self) -> Weights:
        """Of the upper level's network."""
        return self._upper.weights()

    def load(self, weights: Weights) -> None:
        """Load ``weights``."""
        self._upper.load(weights)

    def state_dict(self) -> State:
        """For a checkpoint."""
        return {
            "open": self._open.state_dict(),
            "upper": self._upper.state_dict(),
            "method": self._method.state_dict(),
        }

    def load_state_dict(self, state: State) -> None:
        """Restore from ``state_dict``."""
        self._open.load_state_dict(state["open"])
        self._upper.load_state_dict(state["upper"])
        self._method.load_state_dict(state["method"])
