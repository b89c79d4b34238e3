"""SAC for one sub-task, with the peer's actor and critics across a sub-task boundary (paper, Algorithm 2, line 12)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from t4nmtd_dist.config import LearnerConfig, SACConfig
from t4nmtd_dist.environments.action_spaces import Bounds
from t4nmtd_dist.high_level import QTable
from t4nmtd_dist.learners.actors import scaled
from t4nmtd_dist.learners.attempts import Attempts
from t4nmtd_dist.learners.experience import Experience, Returns
from t4nmtd_dist.learners.exploration import SinusoidExploration
from t4nmtd_dist.learners.networks import Weights
from t4nmtd_dist.learners.peers import PeerCritics, Values
from t4nmtd_dist.learners.sac_published import PublishedSoftCritic
from t4nmtd_dist.learners.sac_update import PeerSoftValues, SACBatch, SACSettings, SACUpdater
from t4nmtd_dist.product import SubtaskTables
from t4nmtd_dist.worlds import Observations

States = NDArray[np.int32]


class SACLearner:
    """Acts in all attempts of a sub-task and learns from a replay of them.

    Args:
        pid: the sub-task.
        attempts: N copies of the world within attempts.
        tables: the sub-task, to read experience for any of its DFA states.
        delta: the DFA's transition table, int32 [Q, letters].
        config: settings shared by all learners.
        sac: settings of SAC.
        high_level: a copy of the coordinator's Q table, for E(Q, q').
        bounds: lowest and highest actions of the environment, float32 [A] each; the actor's [-1, 1] is scaled to them.
        seed: seeds networks and sampling.
    """

    def __init__(
        self,
        pid: str,
        attempts: Attempts,
        tables: SubtaskTables,
        delta: NDArray[np.int32],
        config: LearnerConfig,
        sac: SACConfig,
        high_level: QTable,
        *,
        bounds: Bounds,
        seed: int,
    ) -> None:
        self.pid, self.attempts, self.high_level = pid, attempts, high_level
        self._tables, self._delta, self._config, self._sac = tables, delta, config, sac
        self._readable = np.flatnonzero(tables.available).astype(np.int32)
        self._rng = np.random.default_rng([seed, 1])
        self._low, self._high = bounds
        count, self._observation_size = attempts.observations.shape
        action_size = len(self._low)
        self.experience = Experience(sac.replay_rows // count, count, self._observation_size, action_size)
        self._exploration = SinusoidExploration(count, action_size, sac.exploration_share, self._rng)
        settings = SACSettings(
            learning_rate=sac.learning_rate,
            tau=sac.tau,
            initial_alpha=sac.initial_alpha,
            layer_norm=sac.layer_norm,
            hidden=config.hidden,
        )
        inputs = self._observation_size + len(delta)
        self.updater = SACUpdater(inputs, action_size, settings, seed)
        copy = SACUpdater(inputs, action_size, settings, seed + 1)
        self.published = PublishedSoftCritic(copy, self._observation_size, len(delta))
        self._owed = 0.0
        self._drawn: SACBatch | None = None
        self._fresh = np.ones(count, np.bool_)
        self.value_shape: tuple[int, ...] = (2,)
        self.gradient_steps = 0
        self.version = 0

    def critic_values(self, observations: Observations, q: States) -> Values:
        """(min of the target critics, log pi) of the own actor's action at product states, float32 [k, 2]."""
        values, log_probs = self.updater.soft_values(self._product_states(observations, q))
        return np.stack([values, log_probs], axis=1)

    def weights(self) -> Weights:
        """Copies of all parameters by name, and the bounds that the actor's actions are stretched to."""
        return self.updater.weights() | {"actor.low": self._low, "actor.high": self._high}

    def load(self, weights: Mapping[str, NDArray[Any]], version: int) -> None:
        """Go on from weights learned before."""
        self.updater.load({name: array for name, array in weights.items() if name not in ("actor.low", "actor.high")})
        self.version = version
        self.published.update(self.updater, version)

    def losses(self) -> tuple[float | None, float | None]:
        """Entropy (nats) and critic loss of the last update; None before the first."""
        if not self.gradient_steps:
            return None, None
        found = self.updater.losses()
        return found["entropy"], found["critic_loss"]

    def iterate(self, peers: PeerCritics) -> bool:
        """Some steps of all copies and the updates that they call for; False while there is no state to start from."""
        if not self.attempts.begin():
            return False
        for _ in range(self._sac.steps_per_iteration):
            self._step()
            self._owed += self._sac.updates_per_step * len(self._fresh)
            while self._owed >= 1.0:
                self._owed -= 1.0
                self._train(peers)
        self.version += 1
        self.published.update(self.updater, self.version)
        return True

    def _step(self) -> None:
        attempts = self.attempts
        observations, q = attempts.observations.copy(), attempts.q.copy()
        self._exploration.begin(self._fresh, attempts.recent_success or 0.0)
        chosen = self.updater.act(self._product_states(observations, q), deterministic=False)
        actions = self._exploration.drive(chosen)
        step = attempts.step(scaled(actions, self._low, self._high))
        self.experience.add(
            observations, q, actions, step.letters, step.next_observations, step.terminated, step.ended, step.reached
        )
        self._fresh = step.ended

    def _train(self, peers: PeerCritics) -> None:
        """Train on the batch drawn before, whose peers have had time to answer, and draw the next."""
        if len(self.experience) < self._sac.learning_starts:
            return
        drawn = self._drawn or self._draw(peers)
        answers = peers.gather()
        self._drawn = self._draw(peers)
        values, log_probs = answers.values.reshape(-1, 2).T
        self.updater.update(drawn, PeerSoftValues(answers.rows, values, log_probs))
        self.gradient_steps += 1

    def _draw(self, peers: PeerCritics) -> SACBatch:
        """A batch, each row read in its own DFA state or in another of the sub-task's, with peers asked."""
        sac, experience = self._sac, self.experience
        rows = experience.sample(sac.batch, sac.success_share, self._rng)
        q = experience.q[rows]
        if sac.relabel_share and len(self._readable) > 1:
            other = self._readable[self._rng.integers(len(self._readable), size=len(rows))]
            q = np.where(self._rng.random(len(rows)) < sac.relabel_share, other, q)
        returns = experience.returns(rows, q, self._tables, self._delta, self._config.gamma, sac.n_step)
        next_observations = experience.next_observations[returns.last]
        self._ask(returns, next_observations, peers)
        return SACBatch(
            states=torch.from_numpy(self._product_states(experience.observations[rows], q)),
            actions=torch.from_numpy(experience.actions[rows]),
            rewards=torch.from_numpy((returns.reward * self._config.reward_scale).astype(np.float32)),
            discounts=torch.from_numpy(returns.discount.astype(np.float32)),
            next_states=torch.from_numpy(self._product_states(next_observations, returns.q_next)),
        )

    def _ask(self, returns: Returns, next_observations: Observations, peers: PeerCritics) -> None:
        for row in np.flatnonzero(returns.boundary):
            q_next = int(returns.q_next[row])
            pid = self.high_level.choose(q_next, self._rng)
            if pid is not None and pid != self.pid:
                peers.ask(int(row), pid, next_observations[row], q_next)

    def _product_states(self, observations: Observations, q: States) -> NDArray[np.float32]:
        joined = np.zeros((len(observations), self._observation_size + len(self._delta)), np.float32)
        joined[:, : self._observation_size] = observations
        joined[np.arange(len(observations)), self._observation_size + q] = 1.0
        return joined
