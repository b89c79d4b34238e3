"""PPO for one sub-task, with the peer's value across a sub-task boundary (paper, Algorithm 2, line 12)."""

from __future__ import annotations

import copy
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from t4nmtd_dist.agents.common.flat_adam import FlatAdam
from t4nmtd_dist.agents.common.networks import load_weights, mlp, product_state, weights_of
from t4nmtd_dist.agents.common.normalisation import Normalisation
from t4nmtd_dist.agents.common.peer_values import PeerCritics, Questions, Values
from t4nmtd_dist.agents.common.replay_buffer import Experience
from t4nmtd_dist.agents.common.rollout import Rollout
from t4nmtd_dist.agents.common.successors import draw_successors
from t4nmtd_dist.agents.common.value_request import read_value_request
from t4nmtd_dist.agents.ppo.config import PPOConfig
from t4nmtd_dist.agents.weights import Weights, check_finite
from t4nmtd_dist.core.config import LearnerConfig
from t4nmtd_dist.core.devices import Device
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.environments.batched import Observations
from t4nmtd_dist.method.protocol import Mask, Method

Floats = NDArray[np.float32]
PATIENCE_S = 0.2  # for the answers to what was asked in the last steps of a roll-out


class ActorCritic(nn.Module):
    """Separate networks for the policy's logits and the state value."""

    def __init__(self, inputs: int, actions: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.actor = mlp(inputs, hidden, actions, last_gain=0.01)
        self.critic = mlp(inputs, hidden, 1, last_gain=1.0)

    def value(self, states: Tensor) -> Tensor:
        """State values [N] of product states [N, d + |Q|]."""
        return torch.as_tensor(self.critic(states)).squeeze(-1)


@dataclass
class Trajectory:
    """T steps of N copies; every array begins with the axes [T, N]."""

    states: Floats
    actions: NDArray[np.int64]
    log_probs: Floats
    rewards: Floats
    terminal: Mask
    cut: Mask
    boundary: Mask
    boundary_observations: Floats
    boundary_q: NDArray[np.int32]

    @classmethod
    def empty(cls, steps: int, count: int, inputs: int, observation_size: int) -> Trajectory:
        """Room for a roll-out, to be filled step by step."""
        shape = (steps, count)
        return cls(
            states=np.zeros((*shape, inputs), np.float32),
            actions=np.zeros(shape, np.int64),
            log_probs=np.zeros(shape, np.float32),
            rewards=np.zeros(shape, np.float32),
            terminal=np.zeros(shape, np.bool_),
            cut=np.zeros(shape, np.bool_),
            boundary=np.zeros(shape, np.bool_),
            boundary_observations=np.zeros((*shape, observation_size), np.float32),
            boundary_q=np.zeros(shape, np.int32),
        )


def generalised_advantages(
    rewards: Floats, values: Floats, next_values: Floats, cut: Mask, *, gamma: float, gae_lambda: float
) -> Floats:
    """GAE (Schulman et al., 2016), float32 [T, N].

    Args:
        rewards: scaled rewards [T, N].
        values: V(s_t) [T, N].
        next_values: what each step bootstraps from: 0 at terminals, the peer's value across a boundary, else
            V(s_{t+1}).
        cut: steps after which the trace must not go on [T, N].
        gamma: discount.
        gae_lambda: lambda.
    """
    delta = rewards + gamma * next_values - values
    decay = gamma * gae_lambda * ~cut
    advantages = np.zeros_like(delta)
    carried = np.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        carried = delta[t] + decay[t] * carried
        advantages[t] = carried
    return advantages


class PublishedCritic:
    """A copy of a critic on the CPU, which other threads may evaluate while the original is trained.

    Args:
        critic: the network to copy.
        observation_size: d.
        dfa_states: |Q|.
        normalisation: statistics of its own, to load others into.
    """

    def __init__(self, critic: nn.Module, observation_size: int, dfa_states: int, normalisation: Normalisation) -> None:
        self._copy = copy.deepcopy(critic).cpu()
        self._normalisation = normalisation
        self._observation_size, self._dfa_states = observation_size, dfa_states
        self._version = 0
        self._lock = threading.Lock()

    @torch.no_grad()
    def update(self, critic: nn.Module, version: int, statistics: Mapping[str, NDArray[Any]]) -> None:
        """Copy newer parameters, and statistics of observations."""
        with self._lock:
            self._normalisation.load(statistics)
            for mine, theirs in zip(self._copy.parameters(), critic.parameters(), strict=True):
                mine.copy_(theirs)
            self._version = version

    def weights(self) -> tuple[Weights, int]:
        """The parameters, and their version."""
        with self._lock:
            return weights_of(self._copy) | self._normalisation.weights(), self._version

    def load(self, weights: Mapping[str, NDArray[Any]], version: int) -> None:
        """Answer from the ``weights`` of another copy from now on.

        Raises:
            PolicyError: if names or shapes differ; the copy is of no use then.
            ProtocolError: if they are not finite.
        """
        check_finite(weights)
        with self._lock:
            load_weights(self._copy, self._normalisation.load(weights))
            self._version = version

    @torch.no_grad()
    def values(self, arrays: Mapping[str, NDArray[Any]]) -> tuple[Values, int]:
        """V of the product states in a value request (``observation`` [k, d], ``q`` [k]), and the copy's version.

        Raises:
            ProtocolError: if ``observation`` is not finite float32 [k, d] or ``q`` not [k] states of the DFA.
        """
        observations, q = read_value_request(arrays, self._observation_size, self._dfa_states)
        with self._lock:
            states = product_state(self._normalisation.apply(observations), q, self._dfa_states)
            values: Values = self._copy(states).squeeze(-1).numpy()
            return values, self._version


class PPOLearner:
    """Acts in all attempts of a sub-task and learns from them, one roll-out at a time.

    Args:
        pid: the sub-task.
        rollout: N copies of the environment within attempts.
        config: settings shared by all learners.
        ppo: settings of PPO.
        method: the learner's copy of the method, whose upper level the coordinator keeps up to date.
        dfa_states: |Q|, the width of the one-hot.
        actions: number of actions.
        seed: seeds networks and sampling.
        device: where the networks are; roll-outs are collected on the CPU.
        normalised: which numbers of an observation are normalised, bool [d]; None for none.
    """

    def __init__(
        self,
        pid: str,
        rollout: Rollout,
        config: LearnerConfig,
        ppo: PPOConfig,
        method: Method,
        *,
        dfa_states: int,
        actions: int,
        seed: int,
        device: Device = "cpu",
        normalised: Mask | None = None,
    ) -> None:
        self.pid, self.rollout, self.method = pid, rollout, method
        self._config, self._ppo, self._dfa_states = config, ppo, dfa_states
        self._rng = np.random.default_rng([seed, 1])
        count, observation_size = rollout.observations.shape
        self._normalisation = Normalisation(np.zeros(observation_size, np.bool_) if normalised is None else normalised)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.network = ActorCritic(observation_size + dfa_states, actions, config.hidden).to(device)
        self._device = device
        self._optimiser = FlatAdam.of_module(self.network, ppo.learning_rate, epsilon=1e-5)
        self._trajectory = Trajectory.empty(ppo.rollout, count, observation_size + dfa_states, observation_size)
        self.published = self.replica()
        self.value_shape: tuple[int, ...] = ()
        self.experience = None
        self.peer_steps = self.peer_rows = 0
        self.gradient_steps = 0
        self.version = 0
        self._last_losses: tuple[Tensor, Tensor] | None = None

    def _entropy_coefficient(self) -> float:
        """Exploration gives way to exploitation as attempts succeed: linear between the two settings."""
        success = self.rollout.statistics.recent_success or 0.0
        low, high = self._ppo.entropy_coefficient_successful, self._ppo.entropy_coefficient
        return high + (low - high) * success

    def losses(self) -> tuple[float | None, float | None]:
        """Entropy (nats) and value loss of the last gradient step; None before the first."""
        if self._last_losses is None:
            return None, None
        return float(self._last_losses[0]), float(self._last_losses[1])

    @torch.no_grad()
    def critic_values(self, observations: Observations, q: NDArray[np.int32]) -> Values:
        """V(s, q) of product states, float32 [k]: what peers ask for."""
        values: Values = self.network.value(self._states(observations, q).to(self._device)).cpu().numpy()
        return values

    def _states(self, observations: Observations, q: NDArray[np.int32]) -> Tensor:
        """Product states, with observations normalised."""
        return product_state(self._normalisation.apply(observations), q, self._dfa_states)

    def replica(self) -> PublishedCritic:
        """A critic of the same shape, to be loaded with the weights of a peer."""
        size = self.rollout.observations.shape[1]
        return PublishedCritic(self.network.critic, size, self._dfa_states, self._normalisation.alike())

    def learn_from(self, others: Mapping[str, Experience]) -> None:
        """Do nothing: PPO learns from fresh experience of its own policy only."""

    def weights(self) -> Weights:
        """Copies of all parameters, and of the statistics of observations, by name."""
        return weights_of(self.network) | self._normalisation.weights()

    def load(self, weights: Mapping[str, NDArray[Any]], version: int) -> None:
        """Go on from weights learned before."""
        load_weights(self.network, self._normalisation.load(weights))
        self.version = version
        self.published.update(self.network.critic, version, self._normalisation.weights())

    def state_dict(self) -> State:
        """See ``Learner.state_dict``; a roll-out is over between two iterations, so it is no part."""
        return {
            "weights": self.weights(),
            "optimiser": self._optimiser.state_dict(),
            "attempts": self.rollout.state_dict(),
            "rng": self._rng.bit_generator.state,
            "gradient_steps": self.gradient_steps,
            "version": self.version,
            "losses": self.losses(),
        }

    def load_state_dict(self, state: State) -> None:
        """See ``Learner.load_state_dict``."""
        self.load(state["weights"], state["version"])
        self._optimiser.load_state_dict(state["optimiser"])
        self.rollout.load_state_dict(state["attempts"])
        self._rng.bit_generator.state = state["rng"]
        self.gradient_steps = state["gradient_steps"]
        entropy, value_loss = state["losses"]
        self._last_losses = None if entropy is None else (torch.tensor(entropy), torch.tensor(value_loss))

    def iterate(self, peers: PeerCritics) -> bool:
        """Collect one roll-out and learn from it; False while there is no state to start from."""
        if not self.rollout.begin():
            return False
        self.collect(peers)
        self.learn(peers)
        return True

    @torch.no_grad()
    def collect(self, peers: PeerCritics) -> None:
        """Fill the roll-out; peers are asked about boundaries as they are crossed."""
        trajectory, rollout = self._trajectory, self.rollout
        for t in range(self._ppo.rollout):
            self._normalisation.update(rollout.observations)
            states = self._states(rollout.observations, rollout.q)
            trajectory.states[t] = states.numpy()
            actions, trajectory.log_probs[t] = self._act(states)
            trajectory.actions[t] = actions
            step = rollout.step(actions)
            trajectory.rewards[t] = step.reward * self._config.reward_scale
            trajectory.terminal[t] = step.terminal
            trajectory.cut[t] = step.ended | step.changed
            trajectory.boundary[t] = trajectory.cut[t] & ~step.terminal
            trajectory.boundary_observations[t] = step.next_observations
            trajectory.boundary_q[t] = step.q_next
            self._ask(t, step.changed & ~step.terminal, peers)

    def _act(self, states: Tensor) -> tuple[NDArray[np.int64], Floats]:
        """Sampled actions [N] and their log-probabilities [N]; sampling by the Gumbel trick."""
        log_probs = torch.log_softmax(self.network.actor(states.to(self._device)), -1).cpu().numpy()
        actions = np.argmax(log_probs + self._rng.gumbel(size=log_probs.shape), axis=1)
        return actions, log_probs[np.arange(len(actions)), actions]

    def _ask(self, t: int, crossed: Mask, peers: PeerCritics) -> None:
        trajectory = self._trajectory
        successors = draw_successors(self.method, self.pid, crossed, trajectory.boundary_q[t], self._rng)
        trajectory.terminal[t, successors.without_value] = True
        copies = successors.rows
        if len(copies):
            rows = t * trajectory.rewards.shape[1] + copies
            observations, q = trajectory.boundary_observations[t, copies], trajectory.boundary_q[t, copies]
            peers.ask(self.version, Questions(rows, successors.pids, observations, q))

    def learn(self, peers: PeerCritics) -> None:
        """Advantages and PPO's epochs over the roll-out."""
        with torch.no_grad():
            values, next_values = self._bootstrap(peers)
        trajectory, ppo = self._trajectory, self._ppo
        advantages = generalised_advantages(
            trajectory.rewards,
            values,
            next_values,
            trajectory.cut,
            gamma=self._config.gamma,
            gae_lambda=ppo.gae_lambda,
        )
        self._epochs(advantages.reshape(-1), (advantages + values).reshape(-1))
        self.version += 1
        self.published.update(self.network.critic, self.version, self._normalisation.weights())

    def _bootstrap(self, peers: PeerCritics) -> tuple[Floats, Floats]:
        """V(s_t) and the bootstrap values of s_{t+1}, float32 [T, N] each (the critic target with intervention)."""
        trajectory, rollout = self._trajectory, self.rollout
        last = self._states(rollout.observations, rollout.q)
        flat = torch.from_numpy(trajectory.states.reshape(-1, trajectory.states.shape[-1]))
        own = self.network.value(torch.cat([flat, last]).to(self._device)).cpu().numpy()
        values = own[: len(flat)].reshape(trajectory.rewards.shape)
        next_values = np.concatenate([values[1:], own[None, len(flat) :]])
        crossed = trajectory.boundary
        if crossed.any():
            next_values[crossed] = self.critic_values(
                trajectory.boundary_observations[crossed], trajectory.boundary_q[crossed]
            )
        answers = peers.gather(self.version, PATIENCE_S)
        next_values.reshape(-1)[answers.rows] = answers.values
        next_values[trajectory.terminal] = 0.0
        return values, next_values

    def _epochs(self, advantages: Floats, returns: Floats) -> None:
        trajectory, ppo = self._trajectory, self._ppo
        states = torch.from_numpy(trajectory.states.reshape(len(advantages), -1))
        actions = torch.from_numpy(trajectory.actions.reshape(-1))
        log_probs = torch.from_numpy(trajectory.log_probs.reshape(-1))
        normal = (advantages - advantages.mean()) / max(float(advantages.std()), ppo.advantage_floor)
        columns = [states, actions, log_probs, torch.from_numpy(normal), torch.from_numpy(returns)]
        columns = [column.to(self._device) for column in columns]
        for _ in range(ppo.epochs):
            order = torch.from_numpy(self._rng.permutation(len(advantages))).to(self._device)
            for rows in torch.split(order, ppo.minibatch):
                self.rollout.pulse()
                self._gradient_step(*(column[rows] for column in columns))

    def _gradient_step(
        self, states: Tensor, actions: Tensor, old_log_probs: Tensor, advantages: Tensor, returns: Tensor
    ) -> None:
        ppo = self._ppo
        all_log_probs = torch.log_softmax(self.network.actor(states), -1)
        log_probs = all_log_probs.gather(1, actions[:, None]).squeeze(1)
        ratio = torch.exp(log_probs - old_log_probs)
        clipped = ratio.clamp(1 - ppo.clip, 1 + ppo.clip)
        policy_loss = -torch.minimum(ratio * advantages, clipped * advantages).mean()
        entropy = -(all_log_probs.exp() * all_log_probs).sum(-1).mean()
        value_loss = (self.network.value(states) - returns).square().mean()
        loss = policy_loss + ppo.value_coefficient * value_loss - self._entropy_coefficient() * entropy
        self._optimiser.gradient.zero_()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), ppo.max_grad_norm)
        self._optimiser.step()
        self.gradient_steps += 1
        self._last_losses = entropy.detach(), value_loss.detach()
