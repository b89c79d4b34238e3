"""The learner shared by off-policy agents: acts, stores transitions, and trains."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.batch_source import BatchSource
from t4nmtd_dist.agents.common.batches import Batch
from t4nmtd_dist.agents.common.batches_ahead import BatchesAhead
from t4nmtd_dist.agents.common.context import AgentContext
from t4nmtd_dist.agents.common.off_policy_config import OffPolicyConfig
from t4nmtd_dist.agents.common.peer_values import PeerCritics, PeerValues, Values
from t4nmtd_dist.agents.common.product_states import product_states
from t4nmtd_dist.agents.common.published import Critic, PublishedCritic
from t4nmtd_dist.agents.common.rehearsal import GreedyActor, rehearse
from t4nmtd_dist.agents.common.relabelling import ExperienceReader
from t4nmtd_dist.agents.common.replay_buffer import ReplayBuffer
from t4nmtd_dist.agents.weights import Arrays, Weights
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.environments.batched import Observations

Floats = NDArray[np.float32]
States = NDArray[np.int32]
STEPS_PER_ITERATION = 10  # per environment, between two messages to the coordinator


class OffPolicyAgent(Protocol):
    """The algorithm-specific part of an off-policy learner.

    Intended use::

        actions = agent.act(states, rows, begun, success)
        experience.add(..., actions, *step(agent.environment_actions(actions)))
        agent.update(batch, answers, success)
    """

    action_size: int
    """Numbers of an action in the experience: A of a continuous one, 1 of a discrete one."""
    value_shape: tuple[int, ...]
    """Shape of what ``values`` says of one product state."""

    def act(self, states: Floats, rows: NDArray[np.int64], begun: NDArray[np.bool_], success: float) -> Floats:
        """Actions to store [k, A], with exploration.

        Args:
            states: product states [k, d + |Q|].
            rows: numbers of their environments [k].
            begun: environments among them that have just begun an attempt [k].
            success: recent success rate.
        """

    def environment_actions(self, actions: Floats) -> NDArray[np.generic]:
        """Convert stored actions to the environment's action space."""

    def update(self, batch: Batch, answers: PeerValues, success: float) -> None:
        """One gradient step.

        Args:
            batch: B transitions.
            answers: peers' bootstrap values for some rows.
            success: recent success rate.
        """

    def values(self, states: Floats) -> Values:
        """Bootstrap values at product states [k, d + |Q|], for a peer in this process."""

    def critic_weights(self) -> Weights:
        """Copies of the weights behind ``values``, for ``critic``."""

    def critic(self) -> Critic:
        """A critic of the same shape, on the CPU."""

    def weights(self) -> Weights:
        """Copies of all parameters by name."""

    def load(self, weights: Arrays) -> None:
        """Load ``weights``.

        Raises:
            PolicyError: if names or shapes differ.
        """

    def losses(self) -> tuple[float | None, float | None]:
        """Entropy (nats) and critic loss of the last update; None before the first, or if undefined."""

    def state_dict(self) -> State:
        """Parameters, optimisers and exploration, for a checkpoint."""

    def load_state_dict(self, state: State) -> None:
        """Restore from ``state_dict``."""


class OffPolicyLearner:
    """``Learner`` of an off-policy agent.

    Args:
        rng: draws batches; the agent may share it.
    """

    def __init__(
        self, context: AgentContext, config: OffPolicyConfig, agent: OffPolicyAgent, rng: np.random.Generator
    ) -> None:
        self.pid, self.rollout, self.agent = context.pid, context.rollout, agent
        self._context, self._config, self._rng = context, config, rng
        self._normalisation = context.normalisation()
        count = len(self.rollout.observations)
        self.replay_buffer = ReplayBuffer(
            config.replay_rows // count, count, context.observation_size, agent.action_size
        )
        settings = context.settings
        tables = context.method.role(self.pid).tables
        reader = ExperienceReader(tables, context.task.dfa.delta, settings.gamma, settings.reward_scale, config.n_step)
        self.batches = BatchSource(self.pid, self.replay_buffer, reader, config, context.method, rng)
        self.peer_steps = self._steps_of_each_peer()
        self._ahead = BatchesAhead(context.observation_size)
        self._rows, self._begun = np.arange(count), np.ones(count, np.bool_)
        self._owed = 0.0  # due updates
        self.published = self.replica()
        self.value_shape = agent.value_shape
        self.gradient_steps = 0
        self.version = 0

    def _steps_of_each_peer(self) -> int:
        """The own replay capacity, divided among all peers."""
        peers = len(self._context.task.decomposition.pids) - 1
        return max(1, self.replay_buffer.steps // max(1, peers)) if self.batches.reads_peers else 0

    def iterate(self, peers: PeerCritics) -> bool:
        """Step all environments and run the due updates; False while there is no start state."""
        if not self.rollout.begin():
            return False
        for _ in range(STEPS_PER_ITERATION):
            self._step()
            self._owed += self._config.updates_per_step * len(self._begun)
            while self._owed >= 1.0:
                self._owed -= 1.0
                self._train(peers)
        self.version += 1
        self._publish()
        return True

    def rehearse(self, actor: GreedyActor) -> bool:
        """See ``Learner.rehearse``."""
        self.replay_buffer.end_attempts()
        self._begun[:] = True
        return rehearse(self.rollout, actor, self._context.dfa_states)

    def _step(self) -> None:
        rollout = self.rollout
        observations, q = rollout.observations.copy(), rollout.q.copy()
        self._normalisation.update(observations)
        actions = self.agent.act(self._states(observations, q), self._rows, self._begun, self._success())
        step = rollout.step(self.agent.environment_actions(actions))
        self.replay_buffer.add(
            observations, q, actions, step.symbols, step.next_observations, step.terminated, step.ended, step.reached
        )
        self._begun = step.ended

    def _train(self, peers: PeerCritics) -> None:
        if len(self.replay_buffer) < self._config.learning_starts:
            return
        success = self._success()
        drawn, answers = self._ahead.next(lambda number: self.batches.draw(number, success), peers)
        self.agent.update(drawn.tensors(self._normalisation), answers, success)
        self.gradient_steps += 1

    def _success(self) -> float:
        """Recent success rate; 0 before the first attempt ended."""
        return self.rollout.statistics.recent_success or 0.0

    def _states(self, observations: Observations, q: States) -> Floats:
        """Product states with normalised observations."""
        return product_states(self._normalisation.apply(observations), q, self._context.dfa_states)

    def critic_values(self, observations: Observations, q: States) -> Values:
        """See ``Learner.critic_values``."""
        return self.agent.values(self._states(observations, q))

    def replica(self) -> PublishedCritic:
        """See ``Learner.replica``."""
        return PublishedCritic.of(self.agent.critic(), self._context)

    def _publish(self) -> None:
        self.published.update(self.agent.critic_weights() | self._normalisation.weights(), self.version)

    @property
    def peer_rows(self) -> int:
        """See ``Learner.peer_rows``."""
        return sum(map(len, self.batches.peers_experience()))

    def learn_from(self, others: Mapping[str, ReplayBuffer]) -> None:
        """See ``Learner.learn_from``."""
        self.batches.others = others

    def weights(self) -> Weights:
        """Copies of all parameters and observation statistics by name."""
        return self.agent.weights() | self._normalisation.weights()

    def load(self, weights: Arrays, version: int) -> None:
        """Load trained weights."""
        self.agent.load(self._normalisation.load(weights))
        self.version = version
        self._publish()

    def losses(self) -> tuple[float | None, float | None]:
        """See ``Learner.losses``."""
        return self.agent.losses()

    def state_dict(self) -> State:
        """See ``Learner.state_dict``; the replay's arrays are views."""
        return {
            "agent": self.agent.state_dict(),
            "normalisation": self._normalisation.weights(),
            "experience": self.replay_buffer.state_dict(),
            "attempts": self.rollout.state_dict(),
            "rng": self._rng.bit_generator.state,
            "owed": self._owed,
            "ahead": self._ahead.state_dict(),
            "begun": self._begun.copy(),
            "gradient_steps": self.gradient_steps,
            "version": self.version,
        }

    def load_state_dict(self, state: State) -> None:
        """See ``Learner.load_state_dict``; peers are queried again about the batches drawn ahead."""
        self.replay_buffer.load_state_dict(state["experience"])
        self._normalisation.load(state["normalisation"])
        self.agent.load_state_dict(state["agent"])
        self.rollout.load_state_dict(state["attempts"])
        self._rng.bit_generator.state = state["rng"]
        self._owed, self._begun[:] = state["owed"], state["begun"]
        self.gradient_steps, self.version = state["gradient_steps"], state["version"]
        self._ahead.load_state_dict(state["ahead"], self.gradient_steps)
        self._publish()
