"""SAC for one sub-task, with the peer's actor and critics across a boundary (paper, Algorithm 2, line 12)."""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.action_bounds import scaled
from t4nmtd_dist.agents.common.batches import Batch
from t4nmtd_dist.agents.common.context import AgentContext
from t4nmtd_dist.agents.common.exploration import Exploration
from t4nmtd_dist.agents.common.off_policy import OffPolicyLearner
from t4nmtd_dist.agents.common.peer_values import PeerValues, Values
from t4nmtd_dist.agents.sac.config import SACConfig
from t4nmtd_dist.agents.sac.fast_cpu.update import SACUpdater
from t4nmtd_dist.agents.sac.soft_critic import SoftCritic
from t4nmtd_dist.agents.sac.torch_update import TorchSACUpdater
from t4nmtd_dist.agents.sac.updater import PeerSoftValues, SACSettings, SoftActorCritic
from t4nmtd_dist.agents.weights import Arrays, Weights
from t4nmtd_dist.core.config import LearnerConfig
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.method.rewards import TARGET_REWARD

Floats = NDArray[np.float32]
TAU = 0.005  # step of the target networks


def build(context: AgentContext) -> OffPolicyLearner:
    """See ``protocol.AgentBuilder``."""
    rng = context.rng()
    return OffPolicyLearner(context, context.task.config.agent, algorithm(context, rng), rng)


def algorithm(context: AgentContext, rng: np.random.Generator) -> SAC:
    """See ``protocol.OffPolicyBuilder``."""
    return SAC(context, context.task.config.agent, rng)


def updater_on(device: str, state_size: int, action_size: int, settings: SACSettings, seed: int) -> SoftActorCritic:
    """SAC for a device: hand-written kernels on the CPU, plain torch elsewhere."""
    if device == "cpu":
        return SACUpdater(state_size, action_size, settings, seed)
    return TorchSACUpdater(state_size, action_size, settings, seed, device)


def modest_alpha(config: LearnerConfig, action_size: int) -> float:
    """The entropy coefficient at which acting uniformly at random forever is worth as much as one target.

    With a larger one, learners would prefer noise to a sparse target. The entropy of a uniform action is ln 2 for each
    of its A entries in [-1, 1].
    """
    horizon = 1.0 / max(1.0 - config.gamma, 1.0 / config.attempt_steps)
    return TARGET_REWARD * config.reward_scale / (horizon * action_size * math.log(2.0))


class SAC:
    """``OffPolicyAgent`` by soft actor-critic.

    Attributes:
        updater: the networks and their gradient step.
    """

    value_shape: tuple[int, ...] = (2,)
    """(min of the target critics, log pi) of the own actor's action."""

    def __init__(self, context: AgentContext, config: SACConfig, rng: np.random.Generator) -> None:
        self._config, self._inputs = config, context.inputs
        self._low, self._high = context.action_bounds()
        self.action_size = len(self._low)
        count = len(context.rollout.observations)
        self._exploration = Exploration(config.exploration, config.exploration_share, count, self.action_size, rng)
        self._initial_alpha = config.initial_alpha or modest_alpha(context.settings, self.action_size)
        settings = SACSettings(
            learning_rate=config.learning_rate,
            tau=TAU,
            actor_average=config.actor_average,
            initial_alpha=self._initial_alpha,
            layer_norm=config.layer_norm,
            hidden=context.settings.hidden,
        )
        self.updater = updater_on(context.device, self._inputs, self.action_size, settings, context.seed)
        self._noise_seeds = itertools.count(context.seed + 1)
        self._earlier_losses: tuple[float | None, float | None] = (None, None)

    def act(self, states: Floats, rows: NDArray[np.int64], begun: NDArray[np.bool_], success: float) -> Floats:
        """See ``OffPolicyAgent.act``; actions within [-1, 1]."""
        self._exploration.begin(rows[begun], success)
        return self._exploration.drive(rows, self.updater.act(states, deterministic=False))

    def environment_actions(self, actions: Floats) -> Floats:
        """See ``OffPolicyAgent.environment_actions``."""
        return scaled(actions, self._low, self._high)

    def update(self, batch: Batch, answers: PeerValues, success: float) -> None:
        """See ``OffPolicyAgent.update``.

        The floor of the entropy coefficient falls with the failure rate, so a failing learner keeps exploring.
        """
        config = self._config
        values, log_probs = answers.values.reshape(-1, 2).T
        self.updater.scale_learning_rate(1.0 - config.learning_rate_decay * success**2)
        self.updater.update(batch, PeerSoftValues(answers.rows, values, log_probs))
        self.updater.keep_alpha_above(self._initial_alpha * config.alpha_floor * (1.0 - success) ** 2)

    def values(self, states: Floats) -> Values:
        """See ``OffPolicyAgent.values``; float32 [k, 2]."""
        return np.stack(self.updater.soft_values(states), axis=1)

    def critic(self) -> SoftCritic:
        """See ``OffPolicyAgent.critic``; it owns its weights and noise."""
        return SoftCritic(self._inputs, self.action_size, self.updater.settings, next(self._noise_seeds))

    def critic_weights(self) -> Weights:
        """See ``OffPolicyAgent.critic_weights``."""
        return self.updater.critic_weights()

    def weights(self) -> Weights:
        """Copies of all parameters by name, with the average actor's action bounds."""
        return self.updater.weights() | {"average.low": self._low, "average.high": self._high}

    def load(self, weights: Arrays) -> None:
        """See ``OffPolicyAgent.load``."""
        bounds = ("average.low", "average.high")
        self.updater.load({name: array for name, array in weights.items() if name not in bounds})

    def losses(self) -> tuple[float | None, float | None]:
        """Entropy (nats) and critic loss of the last update; None before the first."""
        found = self.updater.losses()
        return (found["entropy"], found["critic_loss"]) if found else self._earlier_losses

    def state_dict(self) -> State:
        """See ``OffPolicyAgent.state_dict``."""
        return {
            "weights": self.updater.weights(),
            "optimisers": self.updater.optimiser_state(),
            "exploration": self._exploration.state_dict(),
            "losses": self.losses(),
        }

    def load_state_dict(self, state: State) -> None:
        """See ``OffPolicyAgent.load_state_dict``."""
        self.updater.load(state["weights"])
        self.updater.load_optimiser_state(state["optimisers"])
        self._exploration.load_state_dict(state["exploration"])
        self._earlier_losses = tuple(state["losses"])
