"""SAC for one sub-task, with the peer's actor and critics across a sub-task boundary (paper, Algorithm 2, line 12)."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.actors import scaled
from t4nmtd_dist.agents.common.exploration import Exploration
from t4nmtd_dist.agents.common.normalisation import Normalisation
from t4nmtd_dist.agents.common.peer_values import PeerCritics, Values
from t4nmtd_dist.agents.common.replay_buffer import Experience
from t4nmtd_dist.agents.common.rollout import Rollout
from t4nmtd_dist.agents.sac.batches import BatchSource, DrawnBatch, product_states
from t4nmtd_dist.agents.sac.config import SACConfig
from t4nmtd_dist.agents.sac.fast_cpu.update import SACUpdater
from t4nmtd_dist.agents.sac.interface import PeerSoftValues, SACSettings
from t4nmtd_dist.agents.sac.published import PublishedSoftCritic
from t4nmtd_dist.agents.sac.torch_update import updater_on
from t4nmtd_dist.agents.weights import Weights
from t4nmtd_dist.core.config import LearnerConfig
from t4nmtd_dist.core.devices import Device
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.environments.action_spaces import Bounds
from t4nmtd_dist.environments.batched import Observations
from t4nmtd_dist.method.protocol import Method
from t4nmtd_dist.method.rewards import TARGET_REWARD

BATCHES_AHEAD = 16  # twice what shares a request: the other half is the time that peers have to answer

Floats = NDArray[np.float32]
States = NDArray[np.int32]


def modest_alpha(config: LearnerConfig, action_size: int) -> float:
    """The entropy coefficient with which acting uniformly at random for ever is worth as much as one target.

    More would make every learner of a sparse reward prefer noise to its target; the entropy of a uniform action is
    ln 2 for each of its A numbers in [-1, 1].
    """
    horizon = 1.0 / max(1.0 - config.gamma, 1.0 / config.attempt_steps)
    return TARGET_REWARD * config.reward_scale / (horizon * action_size * math.log(2.0))


class SACLearner:
    """Acts in all attempts of a sub-task and learns from a replay of them.

    Args:
        pid: the sub-task.
        rollout: N copies of the environment within attempts.
        delta: the DFA's transition table, int32 [Q, symbols].
        config: settings shared by all learners.
        sac: settings of SAC.
        method: the learner's copy of the method, whose upper level the coordinator keeps up to date.
        bounds: lowest and highest actions of the environment, float32 [A] each; the actor's [-1, 1] is scaled to them.
        seed: seeds networks and sampling.
        peers: how many other sub-tasks there are.
        device: where the networks are trained; what answers peers is on the CPU.
        normalised: which numbers of an observation are normalised, bool [d]; None for none.
    """

    def __init__(
        self,
        pid: str,
        rollout: Rollout,
        delta: NDArray[np.int32],
        config: LearnerConfig,
        sac: SACConfig,
        method: Method,
        *,
        bounds: Bounds,
        seed: int,
        peers: int = 0,
        device: Device = "cpu",
        normalised: NDArray[np.bool_] | None = None,
    ) -> None:
        self.pid, self.rollout = pid, rollout
        self._delta, self._sac = delta, sac
        self._rng = np.random.default_rng([seed, 1])
        self._low, self._high = bounds
        count, self._observation_size = rollout.observations.shape
        action_size = len(self._low)
        size = self._observation_size
        self._normalisation = Normalisation(np.zeros(size, np.bool_) if normalised is None else normalised)
        self.experience = Experience(sac.replay_rows // count, count, self._observation_size, action_size)
        kept_of_each = max(1, self.experience.steps // max(1, peers))  # of all peers together what the own replay holds
        self.batches = BatchSource(pid, self.experience, delta, config, sac, method, self._rng)
        self.peer_steps = kept_of_each if self.batches.reads_peers else 0
        self._exploration = Exploration(sac.exploration, sac.exploration_share, count, action_size, self._rng)
        self._initial_alpha = sac.initial_alpha or modest_alpha(config, action_size)
        settings = SACSettings(
            learning_rate=sac.learning_rate,
            tau=sac.tau,
            actor_average=sac.actor_average,
            initial_alpha=self._initial_alpha,
            layer_norm=sac.layer_norm,
            hidden=config.hidden,
        )
        self.updater = updater_on(device, self._observation_size + len(delta), action_size, settings, seed)
        self._noise_seeds = itertools.count(seed + 1)
        self.published = self.replica()
        self._owed = 0.0
        self._ahead: deque[DrawnBatch] = deque()
        self._asked = 0  # batches of smaller numbers have been asked about
        self._fresh = np.ones(count, np.bool_)
        self._earlier_losses: tuple[float | None, float | None] = (None, None)
        self.value_shape: tuple[int, ...] = (2,)
        self.gradient_steps = 0
        self.version = 0

    def critic_values(self, observations: Observations, q: States) -> Values:
        """(min of the target critics, log pi) of the own actor's action at product states, float32 [k, 2]."""
        values, log_probs = self.updater.soft_values(self._states(observations, q))
        return np.stack([values, log_probs], axis=1)

    def _states(self, observations: Observations, q: States) -> Floats:
        """Product states, with observations normalised."""
        return product_states(self._normalisation.apply(observations), q, len(self._delta))

    def replica(self) -> PublishedSoftCritic:
        """A network of the same shape, with weights of its own, to be loaded with those of a peer."""
        inputs, actions = self._observation_size + len(self._delta), len(self._low)
        copy = SACUpdater(inputs, actions, self.updater.settings, next(self._noise_seeds))
        return PublishedSoftCritic(copy, self._observation_size, len(self._delta), self._normalisation.alike())

    @property
    def peer_rows(self) -> int:
        """See ``Learner.peer_rows``."""
        return sum(map(len, self.batches.peers_experience()))

    def learn_from(self, others: Mapping[str, Experience]) -> None:
        """See ``Learner.learn_from``."""
        self.batches.others = others

    def weights(self) -> Weights:
        """Copies of all parameters by name, with the bounds that the average actor's actions are stretched to.

        Where observations are normalised, their statistics are among them.
        """
        bounds = {"average.low": self._low, "average.high": self._high}
        return self.updater.weights() | bounds | self._normalisation.weights()

    def load(self, weights: Mapping[str, NDArray[Any]], version: int) -> None:
        """Go on from weights learned before."""
        own = self._normalisation.load(weights)
        self.updater.load({name: array for name, array in own.items() if name not in ("average.low", "average.high")})
        self.version = version
        self.published.update(self.updater, version, self._normalisation.weights())

    def losses(self) -> tuple[float | None, float | None]:
        """Entropy (nats) and critic loss of the last update; None before the first."""
        found = self.updater.losses()
        return (found["entropy"], found["critic_loss"]) if found else self._earlier_losses

    def state_dict(self) -> State:
        """See ``Learner.state_dict``; the replay's arrays are views."""
        return {
            "weights": self.updater.weights() | self._normalisation.weights(),
            "optimisers": self.updater.optimiser_state(),
            "experience": self.experience.state_dict(),
            "exploration": self._exploration.state_dict(),
            "attempts": self.rollout.state_dict(),
            "rng": self._rng.bit_generator.state,
            "owed": self._owed,
            "ahead": [vars(drawn) for drawn in self._ahead],
            "fresh": self._fresh.copy(),
            "gradient_steps": self.gradient_steps,
            "version": self.version,
            "losses": self.losses(),
        }

    def load_state_dict(self, state: State) -> None:
        """See ``Learner.load_state_dict``; peers are asked again about the batches that were drawn ahead."""
        self.experience.load(state["experience"])
        self.load(state["weights"], state["version"])
        self.updater.load_optimiser_state(state["optimisers"])
        self._exploration.load_state_dict(state["exploration"])
        self.rollout.load_state_dict(state["attempts"])
        self._rng.bit_generator.state = state["rng"]
        self._owed, self._fresh[:] = state["owed"], state["fresh"]
        self._ahead = deque(
            DrawnBatch(**{**drawn, "asked_pids": tuple(drawn["asked_pids"])}) for drawn in state["ahead"]
        )
        self.gradient_steps = self._asked = state["gradient_steps"]
        self._earlier_losses = tuple(state["losses"])

    def iterate(self, peers: PeerCritics) -> bool:
        """Some steps of all copies and the updates that they call for; False while there is no state to start from."""
        if not self.rollout.begin():
            return False
        for _ in range(self._sac.steps_per_iteration):
            self._step()
            self._owed += self._sac.updates_per_step * len(self._fresh)
            while self._owed >= 1.0:
                self._owed -= 1.0
                self._train(peers)
        self.version += 1
        self.published.update(self.updater, self.version, self._normalisation.weights())
        return True

    def _step(self) -> None:
        rollout = self.rollout
        observations, q = rollout.observations.copy(), rollout.q.copy()
        self._exploration.begin(self._fresh, self._success())
        self._normalisation.update(observations)
        chosen = self.updater.act(self._states(observations, q), deterministic=False)
        actions = self._exploration.drive(chosen)
        step = rollout.step(scaled(actions, self._low, self._high))
        self.experience.add(
            observations, q, actions, step.symbols, step.next_observations, step.terminated, step.ended, step.reached
        )
        self._fresh = step.ended

    def _train(self, peers: PeerCritics) -> None:
        """Train on the batch drawn longest ago, whose peers have had time to answer, and draw the next."""
        if len(self.experience) < self._sac.learning_starts:
            return
        while len(self._ahead) < BATCHES_AHEAD:
            self._ahead.append(self.batches.draw(self.gradient_steps + len(self._ahead), self._success()))
        self._ask(peers)
        drawn = self._ahead.popleft()
        answers = peers.gather(drawn.number)
        values, log_probs = answers.values.reshape(-1, 2).T
        self.updater.scale_learning_rate(1.0 - self._sac.learning_rate_decay * self._success() ** 2)
        self.updater.update(drawn.tensors(self._normalisation), PeerSoftValues(answers.rows, values, log_probs))
        self.updater.keep_alpha_above(self._alpha_floor())
        self.gradient_steps += 1

    def _alpha_floor(self) -> float:
        """A learner that fails goes on exploring: its entropy coefficient falls with its failures, not before them."""
        return self._initial_alpha * self._sac.alpha_floor * (1.0 - self._success()) ** 2

    def _success(self) -> float:
        """Share of the recent attempts that succeeded; 0 before there are any."""
        return self.rollout.statistics.recent_success or 0.0

    def _ask(self, peers: PeerCritics) -> None:
        """Ask peers about the batches ahead that they have not been asked about: after a resume about all of them."""
        for drawn in self._ahead:
            if drawn.number >= self._asked:
                self._asked = drawn.number + 1
                if len(drawn.asked_rows):
                    peers.ask(drawn.number, drawn.questions(self._observation_size))
