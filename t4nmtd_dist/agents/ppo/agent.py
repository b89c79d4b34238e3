"""PPO for one sub-task, with the peer's value across a boundary (paper, Algorithm 2, line 12)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from t4nmtd_dist.agents.common.context import AgentContext
from t4nmtd_dist.agents.common.networks import load_weights, weights_of
from t4nmtd_dist.agents.common.peer_values import PeerCritics, Questions, Values
from t4nmtd_dist.agents.common.product_states import product_states
from t4nmtd_dist.agents.common.published import PublishedCritic
from t4nmtd_dist.agents.common.rehearsal import GreedyActor, rehearse
from t4nmtd_dist.agents.common.replay_buffer import ReplayBuffer
from t4nmtd_dist.agents.common.rollout import RolloutStep
from t4nmtd_dist.agents.common.successors import draw_successors
from t4nmtd_dist.agents.ppo.config import PPOConfig
from t4nmtd_dist.agents.ppo.losses import bootstrap_values, generalised_advantages
from t4nmtd_dist.agents.ppo.networks import ActorCritic, ValueCritic
from t4nmtd_dist.agents.ppo.trajectory import Trajectory
from t4nmtd_dist.agents.ppo.update import PPOUpdate
from t4nmtd_dist.agents.weights import Arrays, Weights
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.environments.batched import Observations
from t4nmtd_dist.method.protocol import Mask

Floats = NDArray[np.float32]
GAE_LAMBDA = 0.95
SUCCESSFUL_ENTROPY_COEFFICIENT = 0.005  # at success rate 1
PATIENCE_S = 0.2  # wait for answers to the queries of a trajectory's last steps


def build(context: AgentContext) -> PPOLearner:
    """See ``protocol.AgentBuilder``."""
    return PPOLearner(context, context.task.config.agent)


class PPOLearner:
    """Learns a sub-task from one trajectory at a time.

    Attributes:
        network: actor and critic.
        trajectory: the last one.
    """

    value_shape: tuple[int, ...] = ()
    replay_buffer = None
    peer_steps = peer_rows = 0

    def __init__(self, context: AgentContext, config: PPOConfig) -> None:
        self.pid, self.rollout, self.method = context.pid, context.rollout, context.method
        self._context, self._config, self._rng = context, config, context.rng()
        self._normalisation = context.normalisation()
        self.network = _initial_network(context)
        self._update = PPOUpdate(self.network, config, context.device, self._rng)
        count = len(self.rollout.observations)
        self.trajectory = Trajectory.empty(config.rollout, count, context.inputs, context.observation_size)
        self.published = self.replica()
        self.version = 0

    @property
    def gradient_steps(self) -> int:
        """See ``Learner.gradient_steps``."""
        return self._update.gradient_steps

    def iterate(self, peers: PeerCritics) -> bool:
        """Collect one trajectory and learn from it; False while there is no start state."""
        if not self.rollout.begin():
            return False
        self.collect(peers)
        self.learn(peers)
        return True

    def rehearse(self, actor: GreedyActor) -> bool:
        """See ``Learner.rehearse``."""
        return rehearse(self.rollout, actor, self._context.dfa_states)

    @torch.no_grad()
    def collect(self, peers: PeerCritics) -> None:
        """Fill the trajectory; queries peers at every boundary crossing."""
        trajectory, rollout = self.trajectory, self.rollout
        for t in range(self._config.rollout):
            self._normalisation.update(rollout.observations)
            states = self._states(rollout.observations, rollout.q)
            trajectory.states[t] = states.numpy()
            trajectory.actions[t], trajectory.log_probs[t] = self._act(states)
            step = rollout.step(trajectory.actions[t])
            self._store(t, step)
            self._ask(t, step.changed & ~step.terminal, peers)

    def _act(self, states: Tensor) -> tuple[NDArray[np.int64], Floats]:
        """Sampled actions [N] and their log-probabilities [N]."""
        log_probs = torch.log_softmax(self.network.actor(states.to(self._context.device)), -1).cpu().numpy()
        actions = np.argmax(log_probs + self._rng.gumbel(size=log_probs.shape), axis=1)
        return actions, log_probs[np.arange(len(actions)), actions]

    def _store(self, t: int, step: RolloutStep) -> None:
        trajectory = self.trajectory
        trajectory.rewards[t] = step.reward * self._context.settings.reward_scale
        trajectory.terminal[t] = step.terminal
        trajectory.cut[t] = step.ended | step.changed
        trajectory.boundary[t] = trajectory.cut[t] & ~step.terminal
        trajectory.boundary_observations[t] = step.next_observations
        trajectory.boundary_q[t] = step.q_next

    def _ask(self, t: int, crossed: Mask, peers: PeerCritics) -> None:
        trajectory = self.trajectory
        successors = draw_successors(self.method, self.pid, crossed, trajectory.boundary_q[t], self._rng)
        trajectory.terminal[t, successors.without_value] = True
        copies = successors.rows
        if len(copies):
            rows = t * trajectory.rewards.shape[1] + copies
            observations, q = trajectory.boundary_observations[t, copies], trajectory.boundary_q[t, copies]
            peers.ask(self.version, Questions(rows, successors.pids, observations, q))

    def learn(self, peers: PeerCritics) -> None:
        """Compute advantages and run PPO's epochs over the trajectory."""
        values, next_values = self.bootstrap(peers)
        advantages = generalised_advantages(
            self.trajectory.rewards,
            values,
            next_values,
            self.trajectory.cut,
            gamma=self._context.settings.gamma,
            gae_lambda=GAE_LAMBDA,
        )
        returns = (advantages + values).reshape(-1)
        self._update.epochs(self.trajectory, advantages.reshape(-1), returns, self._entropy_coefficient())
        self.version += 1
        self._publish()

    @torch.no_grad()
    def bootstrap(self, peers: PeerCritics) -> tuple[Floats, Floats]:
        """V(s_t) and the bootstrap values of s_{t+1}, float32 [T, N] each."""
        trajectory, rollout = self.trajectory, self.rollout
        last = self._states(rollout.observations, rollout.q)
        flat = torch.from_numpy(trajectory.states.reshape(-1, trajectory.states.shape[-1]))
        own = self.network.value(torch.cat([flat, last]).to(self._context.device)).cpu().numpy()
        values = own[: len(flat)].reshape(trajectory.rewards.shape)
        crossed = trajectory.boundary
        boundary_values = self.critic_values(trajectory.boundary_observations[crossed], trajectory.boundary_q[crossed])
        answers = peers.gather(self.version, PATIENCE_S)
        return values, bootstrap_values(trajectory, values, own[len(flat) :], boundary_values, answers)

    def _entropy_coefficient(self) -> float:
        """Decreases linearly with the success rate."""
        success = self.rollout.statistics.recent_success or 0.0
        high = self._config.entropy_coefficient
        low = min(SUCCESSFUL_ENTROPY_COEFFICIENT, high)
        return high + (low - high) * success

    def losses(self) -> tuple[float | None, float | None]:
        """Entropy (nats) and value loss of the last gradient step; None before the first."""
        found = self._update.losses
        return (None, None) if found is None else (float(found[0]), float(found[1]))

    @torch.no_grad()
    def critic_values(self, observations: Observations, q: NDArray[np.int32]) -> Values:
        """V(s, q) of product states, float32 [k], for peers."""
        values: Values = self.network.value(self._states(observations, q).to(self._context.device)).cpu().numpy()
        return values

    def _states(self, observations: Observations, q: NDArray[np.int32]) -> Tensor:
        """Product states with normalised observations."""
        return torch.from_numpy(product_states(self._normalisation.apply(observations), q, self._context.dfa_states))

    def replica(self) -> PublishedCritic:
        """See ``Learner.replica``."""
        return PublishedCritic.of(ValueCritic(self.network.critic), self._context)

    def _publish(self) -> None:
        self.published.update(weights_of(self.network.critic) | self._normalisation.weights(), self.version)

    def learn_from(self, others: Mapping[str, ReplayBuffer]) -> None:
        """Do nothing: PPO is on-policy."""

    def weights(self) -> Weights:
        """Copies of all parameters and observation statistics by name."""
        return weights_of(self.network) | self._normalisation.weights()

    def load(self, weights: Arrays, version: int) -> None:
        """Load trained weights."""
        load_weights(self.network, self._normalisation.load(weights))
        self.version = version
        self._publish()

    def state_dict(self) -> State:
        """See ``Learner.state_dict``; no trajectory is open between iterations, so none is saved."""
        return {
            "weights": self.weights(),
            "update": self._update.state_dict(),
            "attempts": self.rollout.state_dict(),
            "rng": self._rng.bit_generator.state,
            "version": self.version,
        }

    def load_state_dict(self, state: State) -> None:
        """See ``Learner.load_state_dict``."""
        self.load(state["weights"], state["version"])
        self._update.load_state_dict(state["update"])
        self.rollout.load_state_dict(state["attempts"])
        self._rng.bit_generator.state = state["rng"]


def _initial_network(context: AgentContext) -> ActorCritic:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(context.seed)
        return ActorCritic(context.inputs, context.action_count(), context.settings.hidden).to(context.device)
