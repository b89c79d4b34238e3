"""Double DQN for one sub-task, with the peer's value across a boundary (paper, Algorithm 2, line 12)."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.batches import Batch
from t4nmtd_dist.agents.common.context import AgentContext
from t4nmtd_dist.agents.common.networks import load_weights, weights_of
from t4nmtd_dist.agents.common.off_policy import OffPolicyLearner
from t4nmtd_dist.agents.common.peer_values import PeerValues, Values
from t4nmtd_dist.agents.dqn.actor import epsilon_greedy
from t4nmtd_dist.agents.dqn.config import DQNConfig
from t4nmtd_dist.agents.dqn.networks import MaxQCritic, QNetworks
from t4nmtd_dist.agents.dqn.update import DQNUpdate
from t4nmtd_dist.agents.weights import Arrays, Weights
from t4nmtd_dist.core.state_dict import State

Floats = NDArray[np.float32]


def build(context: AgentContext) -> OffPolicyLearner:
    """See ``protocol.AgentBuilder``."""
    rng = context.rng()
    return OffPolicyLearner(context, context.task.config.agent, algorithm(context, rng), rng)


def algorithm(context: AgentContext, rng: np.random.Generator) -> DQN:
    """See ``protocol.OffPolicyBuilder``."""
    networks = initial_networks(context.inputs, context.action_count(), context.settings.hidden, context.seed)
    return DQN(networks, context.task.config.agent, context.device, rng)


def initial_networks(inputs: int, actions: int, hidden: tuple[int, ...], seed: int) -> QNetworks:
    """Initialise the networks from a seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return QNetworks(inputs, actions, hidden)


def epsilon_after(interactions: int, config: DQNConfig) -> float:
    """Epsilon after some interactions: linear over ``epsilon_steps``, then constant."""
    gone = min(1.0, interactions / config.epsilon_steps)
    return config.epsilon_start + gone * (config.epsilon_end - config.epsilon_start)


class DQN:
    """``OffPolicyAgent`` by double DQN.

    Args:
        networks: Q and Q'; moved to the device.

    Attributes:
        updater: performs gradient steps.
        interactions: actions taken so far; determines epsilon.
    """

    action_size = 1
    value_shape: tuple[int, ...] = ()
    """max_a Q'(s, a)."""

    def __init__(self, networks: QNetworks, config: DQNConfig, device: str, rng: np.random.Generator) -> None:
        self.networks = networks.to(device)
        self._config, self._device, self._rng = config, device, rng
        self.updater = DQNUpdate(self.networks, config, device)
        self.interactions = 0

    def act(self, states: Floats, rows: NDArray[np.int64], begun: NDArray[np.bool_], success: float) -> Floats:
        """See ``OffPolicyAgent.act``; epsilon-greedy action indices."""
        q = self.q_values(states)
        epsilon = epsilon_after(self.interactions, self._config)
        self.interactions += len(states)
        actions = epsilon_greedy(q.argmax(1), q.shape[1], epsilon, self._rng)
        return actions.astype(np.float32)[:, None]

    @torch.no_grad()
    def q_values(self, states: Floats) -> Floats:
        """Q(s, .), float32 [N, actions]."""
        q: Floats = self.networks.actor(torch.from_numpy(states).to(self._device)).cpu().numpy()
        return q

    def environment_actions(self, actions: Floats) -> NDArray[np.int64]:
        """See ``OffPolicyAgent.environment_actions``; int64 [N]."""
        return actions[:, 0].astype(np.int64)

    def update(self, batch: Batch, answers: PeerValues, success: float) -> None:
        """See ``OffPolicyAgent.update``."""
        self.updater.step(batch, answers)

    @torch.no_grad()
    def values(self, states: Floats) -> Values:
        """See ``OffPolicyAgent.values``; float32 [k]."""
        values: Values = self.networks.target(torch.from_numpy(states).to(self._device)).amax(-1).cpu().numpy()
        return values

    def critic(self) -> MaxQCritic:
        """See ``OffPolicyAgent.critic``."""
        return MaxQCritic(self.networks.target)

    def critic_weights(self) -> Weights:
        """See ``OffPolicyAgent.critic_weights``."""
        return weights_of(self.networks.target)

    def weights(self) -> Weights:
        """Copies of all parameters by name: ``actor.*`` and ``target.*``."""
        return weights_of(self.networks)

    def load(self, weights: Arrays) -> None:
        """See ``OffPolicyAgent.load``."""
        load_weights(self.networks, weights)

    def losses(self) -> tuple[float | None, float | None]:
        """See ``OffPolicyAgent.losses``; a greedy policy has no entropy."""
        loss = self.updater.loss
        return None, None if loss is None else float(loss)

    def state_dict(self) -> State:
        """See ``OffPolicyAgent.state_dict``."""
        return {"weights": self.weights(), "update": self.updater.state_dict(), "interactions": self.interactions}

    def load_state_dict(self, state: State) -> None:
        """See ``OffPolicyAgent.load_state_dict``."""
        self.load(state["weights"])
        self.updater.load_state_dict(state["update"])
        self.interactions = state["interactions"]
