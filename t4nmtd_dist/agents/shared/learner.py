"""The learner of a method whose roles share one environment.

N copies play whole episodes, each following one role at a time. All steps go into one replay buffer, from which every
network draws what its roles read. The updates due are divided equally among the networks.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.attempt_statistics import AttemptStatistics
from t4nmtd_dist.agents.common.batches import Batch
from t4nmtd_dist.agents.common.context import AgentContext
from t4nmtd_dist.agents.common.off_policy import STEPS_PER_ITERATION, OffPolicyAgent
from t4nmtd_dist.agents.common.peer_values import PeerCritics, PeerValues, Values
from t4nmtd_dist.agents.common.product_states import product_states
from t4nmtd_dist.agents.common.replay_buffer import ReplayBuffer
from t4nmtd_dist.agents.common.rollout import RolloutStep
from t4nmtd_dist.agents.shared.batches import SharedBatch, SharedBatches
from t4nmtd_dist.agents.shared.options import OptionsInProgress
from t4nmtd_dist.agents.shared.role_rows import RoleRows
from t4nmtd_dist.agents.shared.unasked import UnaskedCritic
from t4nmtd_dist.agents.weights import UPPER, Arrays, Weights, networks_of, of_network
from t4nmtd_dist.core.errors import PolicyError
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.environments.batched import Observations
from t4nmtd_dist.method.active_roles import ActiveRoles
from t4nmtd_dist.method.options import OptionMethod

Floats = NDArray[np.float32]
States = NDArray[np.int32]
Algorithm = Callable[[AgentContext, np.random.Generator], OffPolicyAgent]


def network_seed(seed: int, network: str) -> int:
    """A separate seed for every network of a learner."""
    return int(np.random.SeedSequence([seed, zlib.crc32(network.encode())]).generate_state(1)[0] >> 1)


class SharedLearner:
    """``Learner`` of all roles of a method.

    Args:
        context: its rollout plays ``Episodes``.
        algorithm: builds the agent of one network.

    Attributes:
        agents: by network.
    """

    value_shape: tuple[int, ...] = ()
    replay_buffer = None
    peer_steps = peer_rows = 0

    def __init__(self, context: AgentContext, algorithm: Algorithm) -> None:
        self.pid, self.rollout, self._context, self._method = context.pid, context.rollout, context, context.method
        self._config, self._rng = context.task.config.agent, context.rng()
        self._normalisation = context.normalisation()
        self._roles = [self._method.role(name) for name in self._method.roles]
        self._goals = sum(role.goal is not None for role in self._roles)
        self.agents: dict[str, OffPolicyAgent] = {
            network: algorithm(self._network_context(network), self._rng)
            for network in dict.fromkeys(role.network for role in self._roles)
        }
        self._first_agent = next(iter(self.agents.values()))
        count = len(self.rollout.observations)
        self._replay = ReplayBuffer(
            self._config.replay_rows // count, count, context.observation_size, self._first_agent.action_size
        )
        self._role_rows = RoleRows(self._replay, len(self._roles))
        delta = context.task.dfa.delta
        self.batches = SharedBatches(
            self._replay, self._role_rows, self._method, delta, context.settings, self._config, self._rng
        )
        self._turns = {network: AttemptStatistics() for network in self.agents}
        self._active = ActiveRoles(self._method, count)
        self._begun = np.ones(count, np.bool_)
        self._options = self._options_in_progress(count)
        self._owed = 0.0  # due updates
        self._updates = 0
        self.published = UnaskedCritic()
        self.version = 0

    def _network_context(self, network: str) -> AgentContext:
        goals = self._goals if any(role.goal is not None for role in self._roles if role.network == network) else 0
        return replace(self._context, seed=network_seed(self._context.seed, network), goals=goals)

    def _options_in_progress(self, count: int) -> OptionsInProgress | None:
        if not isinstance(self._method, OptionMethod):
            return None
        seed = network_seed(self._context.seed, UPPER)
        return OptionsInProgress(self._method, self._context, count, self._states, seed, self._rng)

    @property
    def gradient_steps(self) -> int:
        """See ``Learner.gradient_steps``; updates of all networks and of the upper level."""
        return self._updates + (self._options.gradient_steps if self._options else 0)

    # Acting

    def iterate(self, peers: PeerCritics) -> bool:
        """Step all copies and run the updates due."""
        if not self._begin():
            return False
        for _ in range(STEPS_PER_ITERATION):
            self._step()
            self._owed += self._config.updates_per_step * len(self._begun)
            while self._owed >= 1.0:
                self._owed -= 1.0
                self._train()
        self.version += 1
        return True

    def _begin(self) -> bool:
        """Begin the first episodes, once."""
        begun_before = self.rollout.interactions > 0
        if not self.rollout.begin():
            return False
        if not begun_before:
            self._choose(np.arange(len(self._begun)))
        return True

    def _step(self) -> None:
        rollout = self.rollout
        observations, q = rollout.observations.copy(), rollout.q.copy()
        self._normalisation.update(observations)
        actions = self._actions(observations, q)
        roles = self._active.numbers.copy()
        step = rollout.step(self._first_agent.environment_actions(actions))
        over = self._active.advance(q, step.q_next) | step.ended
        reached = self._reached(roles, q, step)
        cut = over & ~step.ended & (q == step.q_next)  # a role's time limit: its return ends here, and bootstraps
        self._replay.add(
            observations,
            q,
            actions,
            step.symbols,
            step.next_observations,
            step.terminated,
            step.ended | cut,
            np.zeros(len(q), np.bool_),
        )
        self._role_rows.record(roles, reached)
        self._count_turns(roles, reached, step)
        if self._options:
            self._options.after_step(roles, q, step, np.flatnonzero(over))
        self._begun[:] = over
        if over.any():
            self._choose(np.flatnonzero(over))

    def _actions(self, observations: Observations, q: States) -> Floats:
        """Actions to store [N, A], each by the network of the copy's role."""
        actions = np.zeros((len(q), self._first_agent.action_size), np.float32)
        for network, agent in self.agents.items():
            rows = np.flatnonzero([self._roles[number].network == network for number in self._active.numbers])
            if len(rows):
                states = self._with_goals(self._states(observations[rows], q[rows]), rows)
                actions[rows] = agent.act(states, rows, self._begun[rows], self._success(network))
        return actions

    def _with_goals(self, states: Floats, rows: NDArray[np.int64]) -> Floats:
        if not self._goals:
            return states
        goals = np.array([self._roles[number].goal for number in self._active.numbers[rows]])
        joined = np.zeros((len(rows), states.shape[1] + self._goals), np.float32)
        joined[:, : states.shape[1]] = states
        joined[np.arange(len(rows)), states.shape[1] + goals] = 1.0
        return joined

    def _reached(self, roles: States, q: States, step: RolloutStep) -> NDArray[np.bool_]:
        """Copies whose role reached one of its targets, bool [N]."""
        return np.array(
            [self._roles[role].tables.target[a, b] for role, a, b in zip(roles, q, step.q_next, strict=True)], np.bool_
        )

    def _count_turns(self, roles: States, reached: NDArray[np.bool_], step: RolloutStep) -> None:
        """A network's turn ends with each change of the DFA state; exploration falls with the share that succeeds."""
        for copy in np.flatnonzero(step.changed | step.ended):
            self._turns[self._roles[roles[copy]].network].add(bool(reached[copy]), 0)

    def _choose(self, rows: NDArray[np.int64]) -> None:
        observations, q = self.rollout.observations[rows], self.rollout.q[rows]
        self._active.choose(rows, q, observations, self._rng)
        if self._options:
            self._options.open(rows, observations, q, self._active.numbers[rows])

    def _success(self, network: str) -> float:
        """Recent success rate of a network's turns; 0 before the first."""
        return self._turns[network].recent_success or 0.0

    def _states(self, observations: Observations, q: States) -> Floats:
        """Product states with normalised observations."""
        return product_states(self._normalisation.apply(observations), q, self._context.dfa_states)

    # Learning

    def _train(self) -> None:
        """Update one network, in turn among those with enough rows."""
        if len(self._replay) < self._config.learning_starts:
            return
        able = [name for name in self.agents if self.batches.rows_for(name) >= self._config.batch]
        if not able:
            return
        network = able[self._updates % len(able)]
        self._updates += 1
        self.agents[network].update(*self._batch(network), self._success(network))

    def _batch(self, network: str) -> tuple[Batch, PeerValues]:
        drawn = self.batches.draw(network)
        read, apply = drawn.read, self._normalisation.apply_to_states
        states, next_states = apply(read.states), apply(read.next_states)
        answers = self._successors_values(network, drawn, next_states)
        return Batch.of(states, read.actions, read.rewards, read.discounts, next_states), answers

    def _successors_values(self, network: str, drawn: SharedBatch, next_states: Floats) -> PeerValues:
        """Values of the roles that follow, where they have another network; for one of its own, no answer is needed."""
        rows = drawn.successors.rows
        names = np.array([self._method.role(name).network for name in drawn.successors.pids])
        answers = []
        for name in np.unique(names):
            if name != network:
                asked = rows[names == name]
                answers.append(PeerValues(asked, self.agents[name].values(next_states[asked])))
        return PeerValues.joined(answers)

    # Everything else

    def rehearse(self, actor: object) -> bool:
        """Not needed: such methods learn all the time."""
        raise NotImplementedError(f"{self._context.settings.method} is not trained in stages")

    def learn_from(self, others: Mapping[str, ReplayBuffer]) -> None:
        """See ``Learner.learn_from``; there are no peers."""

    def critic_values(self, observations: Observations, q: States) -> Values:
        """See ``Learner.critic_values``; there are no peers."""
        raise NotImplementedError(f"{self._context.settings.method} has one learner, which nobody asks")

    def replica(self) -> UnaskedCritic:
        """See ``Learner.replica``."""
        return UnaskedCritic()

    def weights(self) -> Weights:
        """Copies of all parameters and observation statistics, named ``network:name``."""
        found = self._normalisation.weights()
        for network, agent in self.agents.items():
            found |= of_network(network, agent.weights())
        if self._options:
            found |= of_network(UPPER, self._options.weights())
        return found

    def load(self, weights: Arrays, version: int) -> None:
        """Load trained weights."""
        networks = networks_of(self._normalisation.load(weights))
        expected = {*self.agents, *([UPPER] if self._options else [])}
        if networks.keys() != expected:
            raise PolicyError(f"weights of networks {', '.join(networks)}; expected {', '.join(sorted(expected))}")
        for network, agent in self.agents.items():
            agent.load(networks[network])
        if self._options:
            self._options.load(networks[UPPER])
        self.version = version

    def losses(self) -> tuple[float | None, float | None]:
        """See ``Learner.losses``; means over the networks."""
        found = [agent.losses() for agent in self.agents.values()]
        return _mean(entropy for entropy, _ in found), _mean(loss for _, loss in found)

    def state_dict(self) -> State:
        """See ``Learner.state_dict``; the replay's arrays are views."""
        return {
            "agents": {network: agent.state_dict() for network, agent in self.agents.items()},
            "normalisation": self._normalisation.weights(),
            "experience": self._replay.state_dict(),
            "role_rows": self._role_rows.state_dict(),
            "turns": {network: [turns.counts, turns.recent] for network, turns in self._turns.items()},
            "active": self._active.state_dict(),
            "options": self._options.state_dict() if self._options else None,
            "attempts": self.rollout.state_dict(),
            "rng": self._rng.bit_generator.state,
            "owed": self._owed,
            "begun": self._begun.copy(),
            "updates": self._updates,
            "version": self.version,
        }

    def load_state_dict(self, state: State) -> None:
        """See ``Learner.load_state_dict``."""
        self._replay.load_state_dict(state["experience"])
        self._role_rows.load_state_dict(state["role_rows"])
        self._normalisation.load(state["normalisation"])
        for network, agent in self.agents.items():
            agent.load_state_dict(state["agents"][network])
            self._turns[network].load(*state["turns"][network])
        self._active.load_state_dict(state["active"])
        if self._options:
            self._options.load_state_dict(state["options"])
        self.rollout.load_state_dict(state["attempts"])
        self._rng.bit_generator.state = state["rng"]
        self._owed, self._begun[:] = state["owed"], state["begun"]
        self._updates, self.version = state["updates"], state["version"]


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
