"""Our DQN against Stable-Baselines3's on CartPole-v1: returns after equal interactions, from equal seeds.

    python benchmarks/cartpole.py [--interactions 20000] [--seeds 0 1] [--json]

Both use the same layer sizes, learning rate, batch, discount, target step, gradient clip and epsilon schedule. Both
make one update per two interactions, with one-step targets, from an unbounded replay buffer; time-outs bootstrap. Ours
is Double DQN with tanh layers, theirs DQN with ReLU layers. Ours runs the learners' ``DQN`` and ``ReplayBuffer`` in the
plain loop below, with a one-state DFA and CartPole's own reward.

Every return is the mean of 20 greedy episodes from the same starts; the maximum is 500.
It needs Stable-Baselines3 (the ``test`` extra).
"""

from __future__ import annotations

import os

if __name__ == "__main__":  # before numpy and torch are imported
    os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import gymnasium
import numpy as np
import stable_baselines3
import torch
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.batches import Batch
from t4nmtd_dist.agents.common.peer_values import PeerValues
from t4nmtd_dist.agents.common.replay_buffer import ReplayBuffer
from t4nmtd_dist.agents.dqn.agent import DQN, initial_networks
from t4nmtd_dist.agents.dqn.config import DQNConfig
from t4nmtd_dist.method.rewards import SubtaskTables

Floats = NDArray[np.float32]

WORLD = "CartPole-v1"
HIDDEN, GAMMA, STEPS_PER_UPDATE = (64, 64), 0.99, 2
CONFIG = DQNConfig(num_envs=1, batch=128, learning_rate=1e-3, learning_starts=500, epsilon_steps=5000)
EPISODES, FIRST_EVALUATION_SEED = 20, 1_000_000

DELTA = np.zeros((1, 1), np.int32)
NO, YES = np.zeros(1, np.bool_), np.ones(1, np.bool_)
ONE_STATE = SubtaskTables(np.zeros((1, 1), np.bool_), YES, NO, NO, np.zeros((1, 1)), np.zeros(1))
NO_ANSWERS = PeerValues.joined([])


class Agent(Protocol):
    """One side of the comparison."""

    def train(self, interactions: int) -> None:
        """Train for some interactions."""

    def actions(self, observations: Floats) -> NDArray[np.int64]:
        """Greedy actions [N] for observations [N, d]."""


class Ours:
    """Our agent and replay buffer in a plain loop.

    Args:
        seed: of environment, networks and sampling.
        interactions: total number; the buffer keeps all.
    """

    def __init__(self, seed: int, interactions: int) -> None:
        self._env = gymnasium.make(WORLD)
        self._observation: Floats = self._env.reset(seed=seed)[0]
        size = len(self._observation)
        self._rng = np.random.default_rng(seed)
        self._agent = DQN(initial_networks(size, 2, HIDDEN, seed), CONFIG, "cpu", self._rng)
        self.replay_buffer = ReplayBuffer(interactions, 1, size, self._agent.action_size)
        self._rewards = np.zeros(interactions, np.float32)  # the buffer derives its rewards from a DFA
        self.updates = 0

    def train(self, interactions: int) -> None:
        """See ``Agent``."""
        for _ in range(interactions):
            self._step()
            number = len(self.replay_buffer)
            if number > CONFIG.learning_starts and number % STEPS_PER_UPDATE == 0:
                self._agent.update(self.draw(), NO_ANSWERS, 0.0)
                self.updates += 1

    def _step(self) -> None:
        before, number = self._observation[None], len(self.replay_buffer)
        action = self._agent.act(before, np.zeros(1, np.int64), NO, 0.0)
        after, reward, terminated, truncated, _ = self._env.step(self._agent.environment_actions(action)[0])
        over = terminated or truncated
        q, symbols = np.zeros(1, np.int32), np.zeros(1, np.int64)
        self.replay_buffer.add(before, q, action, symbols, after[None], np.array([terminated]), np.array([over]), NO)
        self._rewards[number] = reward
        self._observation = self._env.reset()[0] if over else after

    def draw(self) -> Batch:
        """A batch of one-step targets."""
        experience = self.replay_buffer
        rows = experience.sample(CONFIG.batch, 0.0, self._rng)
        returns = experience.returns(rows, experience.q[rows], ONE_STATE, DELTA, GAMMA, 1)
        columns = (
            experience.observations[rows],
            experience.actions[rows],
            self._rewards[rows],
            returns.discount.astype(np.float32),
            experience.next_observations[rows],
        )
        return Batch(*map(torch.from_numpy, columns))

    def actions(self, observations: Floats) -> NDArray[np.int64]:
        """See ``Agent``."""
        greedy: NDArray[np.int64] = self._agent.q_values(observations).argmax(1)
        return greedy


class Theirs:
    """Stable-Baselines3's DQN with the same settings and arguments."""

    def __init__(self, seed: int, interactions: int) -> None:
        self._dqn = stable_baselines3.DQN(
            "MlpPolicy",
            gymnasium.make(WORLD),
            learning_rate=CONFIG.learning_rate,
            buffer_size=interactions,
            learning_starts=CONFIG.learning_starts,
            batch_size=CONFIG.batch,
            tau=CONFIG.tau,
            gamma=GAMMA,
            train_freq=STEPS_PER_UPDATE,
            gradient_steps=1,
            target_update_interval=1,
            exploration_fraction=CONFIG.epsilon_steps / interactions,
            exploration_initial_eps=CONFIG.epsilon_start,
            exploration_final_eps=CONFIG.epsilon_end,
            max_grad_norm=CONFIG.max_grad_norm,
            policy_kwargs={"net_arch": list(HIDDEN)},
            device="cpu",
            seed=seed,
        )

    @property
    def updates(self) -> int:
        """Gradient updates so far."""
        return int(self._dqn._n_updates)

    def train(self, interactions: int) -> None:
        """See ``Agent``."""
        self._dqn.learn(interactions, log_interval=None)  # type: ignore[arg-type]

    def actions(self, observations: Floats) -> NDArray[np.int64]:
        """See ``Agent``."""
        actions: NDArray[np.int64] = self._dqn.predict(observations, deterministic=True)[0]
        return actions


AGENTS: Mapping[str, Callable[[int, int], Agent]] = {"ours": Ours, "Stable-Baselines3": Theirs}


def mean_return(agent: Agent, episodes: int = EPISODES) -> float:
    """Mean return of greedy episodes from fixed starts."""
    envs = [gymnasium.make(WORLD) for _ in range(episodes)]
    observations = np.array([env.reset(seed=FIRST_EVALUATION_SEED + i)[0] for i, env in enumerate(envs)], np.float32)
    playing, total = np.ones(episodes, np.bool_), 0.0
    while playing.any():
        actions = agent.actions(observations)
        for i in np.flatnonzero(playing):
            observations[i], reward, terminated, truncated, _ = envs[i].step(int(actions[i]))
            total += float(reward)
            playing[i] = not (terminated or truncated)
    return total / episodes


def compared(interactions: int, seeds: list[int]) -> dict[str, dict[str, Any]]:
    """By agent: returns per seed, their mean, and CPU seconds of training."""
    found: dict[str, dict[str, Any]] = {name: {"returns": [], "cpu_s": []} for name in AGENTS}
    for seed in seeds:
        for name, make in AGENTS.items():
            agent, began = make(seed, interactions), time.process_time()
            agent.train(interactions)
            found[name]["cpu_s"].append(round(time.process_time() - began, 1))
            found[name]["returns"].append(mean_return(agent))
            print(f"seed {seed}, {name}: {found[name]['returns'][-1]:.1f}", file=sys.stderr, flush=True)
    for of_agent in found.values():
        of_agent["mean"] = statistics.mean(of_agent["returns"])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--interactions", type=int, default=20_000)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    found = compared(arguments.interactions, arguments.seeds)
    if arguments.json:
        print(json.dumps({"interactions": arguments.interactions, "seeds": arguments.seeds, "agents": found}))
        return
    for name, of_agent in found.items():
        print(f"{name}: {of_agent['mean']:.1f} {of_agent['returns']}")


if __name__ == "__main__":
    main()
