"""Our SAC against Stable-Baselines3's on Pendulum-v1: returns after equal interactions, from equal seeds.

    python benchmarks/pendulum.py [--interactions 5000] [--seeds 0 1 2] [--json]

Both use the same networks, learning rate, batch, discount, target step and initial entropy coefficient. Both begin with
the same number of uniformly random actions, then make one update per interaction with one-step targets; time-outs
bootstrap. Ours runs the learners' ``SACUpdater`` and ``ReplayBuffer`` in the plain loop below: no exploration by waves,
a one-state DFA, and Pendulum's own dense reward.

Every return is the mean of 20 deterministic episodes from the same starts. The agents train in turns, so that load
slows both alike; updates/s count acting, environment step, sampling and gradient step by CPU time.

Ours is at least as good if its mean is at most one standard error of the difference below Stable-Baselines3's:
sqrt(s_ours^2 / n + s_theirs^2 / n), with the standard deviations over the n seeds' returns. The error is printed,
because few seeds with a wide spread could hide much.
It needs Stable-Baselines3 (the ``test`` extra).
"""

from __future__ import annotations

import os

if __name__ == "__main__":  # before numpy and torch are imported
    os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import json
import math
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import SAC

from t4nmtd_dist.agents.common.action_bounds import scaled
from t4nmtd_dist.agents.common.batches import Batch
from t4nmtd_dist.agents.common.replay_buffer import ReplayBuffer
from t4nmtd_dist.agents.sac.fast_cpu.update import SACUpdater
from t4nmtd_dist.agents.sac.updater import SACSettings
from t4nmtd_dist.method.rewards import SubtaskTables

Floats = NDArray[np.float32]

WORLD = "Pendulum-v1"
BATCH, GAMMA, STARTS = 256, 0.99, 100
SETTINGS = SACSettings(initial_alpha=1.0, layer_norm=False, hidden=(256, 256))
EPISODES, FIRST_EVALUATION_SEED = 20, 1_000_000
TURN = 250  # interactions

DELTA = np.zeros((1, 1), np.int32)
NO, YES = np.zeros(1, np.bool_), np.ones(1, np.bool_)
ONE_STATE = SubtaskTables(np.zeros((1, 1), np.bool_), YES, NO, NO, np.zeros((1, 1)), np.zeros(1))


class Agent(Protocol):
    """One side of the comparison."""

    @property
    def updates(self) -> int:
        """Gradient updates so far."""

    def train(self, interactions: int) -> None:
        """Continue training for some interactions."""

    def actions(self, observations: Floats) -> Floats:
        """Deterministic actions [N, A] in the environment's units for observations [N, d]."""


class Ours:
    """Our updater and replay buffer in a plain loop.

    Args:
        seed: of environment, networks and sampling.
        interactions: total number; the buffer keeps all.
    """

    def __init__(self, seed: int, interactions: int, settings: SACSettings = SETTINGS) -> None:
        self._env = gymnasium.make(WORLD)
        space = self._env.action_space
        assert isinstance(space, gymnasium.spaces.Box)
        self._low, self._high = space.low, space.high
        self._observation: Floats = self._env.reset(seed=seed)[0]
        observation_size, action_size = len(self._observation), len(space.low)
        self.replay_buffer = ReplayBuffer(interactions, 1, observation_size, action_size)
        self._rewards = np.zeros(interactions, np.float32)  # the buffer derives its rewards from a DFA
        self._updater = SACUpdater(observation_size, action_size, settings, seed)
        self._rng = np.random.default_rng(seed)
        self._updates = 0

    @property
    def updates(self) -> int:
        """See ``Agent``."""
        return self._updates

    def train(self, interactions: int) -> None:
        """Like Stable-Baselines3's ``OffPolicyAlgorithm.learn``: a step, then an update after the random steps."""
        for _ in range(interactions):
            self._step()
            if len(self.replay_buffer) > STARTS:
                self._updater.update(self._draw())
                self._updates += 1

    def _step(self) -> None:
        before, number = self._observation[None], len(self.replay_buffer)
        if number < STARTS:
            action = self._rng.uniform(-1, 1, (1, len(self._low))).astype(np.float32)
        else:
            action = self._updater.act(before, deterministic=False)
        after, reward, terminated, truncated, _ = self._env.step(scaled(action, self._low, self._high)[0])
        over = terminated or truncated
        q = symbols = np.zeros(1, np.int64)
        ended, fell = np.array([over]), np.array([terminated])
        self.replay_buffer.add(before, q.astype(np.int32), action, symbols, after[None], fell, ended, NO)
        self._rewards[number] = reward
        self._observation = self._env.reset()[0] if over else after

    def _draw(self) -> Batch:
        experience = self.replay_buffer
        rows = experience.sample(BATCH, 0.0, self._rng)
        returns = experience.returns(rows, experience.q[rows], ONE_STATE, DELTA, GAMMA, 1)
        columns = (
            experience.observations[rows],
            experience.actions[rows],
            self._rewards[rows],
            returns.discount.astype(np.float32),
            experience.next_observations[returns.last],
        )
        return Batch(*map(torch.from_numpy, columns))

    def actions(self, observations: Floats) -> Floats:
        """See ``Agent``."""
        return scaled(self._updater.act(observations, deterministic=True), self._low, self._high)


class Theirs:
    """Stable-Baselines3's SAC with the same settings and arguments."""

    def __init__(self, seed: int, interactions: int, settings: SACSettings = SETTINGS) -> None:
        self._sac = SAC(
            "MlpPolicy",
            gymnasium.make(WORLD),
            learning_rate=settings.learning_rate,
            buffer_size=interactions,
            learning_starts=STARTS,
            batch_size=BATCH,
            tau=settings.tau,
            gamma=GAMMA,
            train_freq=1,
            gradient_steps=1,
            ent_coef=f"auto_{settings.initial_alpha}",
            policy_kwargs={"net_arch": list(settings.hidden)},
            device="cpu",
            seed=seed,
        )

    @property
    def updates(self) -> int:
        """See ``Agent``."""
        return int(self._sac._n_updates)

    def train(self, interactions: int) -> None:
        """See ``Agent``; the first call resets the environment, later calls continue."""
        self._sac.learn(interactions, reset_num_timesteps=False, log_interval=None)  # type: ignore[arg-type]

    def actions(self, observations: Floats) -> Floats:
        """See ``Agent``."""
        actions: Floats = self._sac.predict(observations, deterministic=True)[0]
        return actions


THEIRS = "Stable-Baselines3"
AGENTS: Mapping[str, Callable[[int, int], Agent]] = {
    "ours": Ours,
    "ours, layer norm": lambda seed, total: Ours(seed, total, replace(SETTINGS, layer_norm=True)),
    THEIRS: Theirs,
}


def mean_return(agent: Agent, episodes: int = EPISODES) -> float:
    """Mean return of deterministic episodes from fixed starts; all end by time-out in the same step."""
    envs = [gymnasium.make(WORLD) for _ in range(episodes)]
    starts = [env.reset(seed=FIRST_EVALUATION_SEED + i)[0] for i, env in enumerate(envs)]
    observations, total, over = np.array(starts, np.float32), 0.0, False
    while not over:
        steps = [env.step(action) for env, action in zip(envs, agent.actions(observations), strict=True)]
        observations = np.array([step[0] for step in steps], np.float32)
        total += sum(float(step[1]) for step in steps)
        over = steps[0][3]
    return total / episodes


@dataclass
class Course:
    """One agent's training with one seed: mean returns half-way and at the end, and update costs."""

    returns: list[float] = field(default_factory=list)
    updates: int = 0
    cpu_s: float = 0.0


Courses = dict[str, list[Course]]  # by agent, one per seed


def train_in_turns(seed: int, interactions: int, names: list[str]) -> dict[str, Course]:
    """Train the named agents with one seed."""
    agents = {name: AGENTS[name](seed, interactions) for name in names}
    courses = {name: Course() for name in names}
    half = interactions // 2
    for begin, end in ((0, half), (half, interactions)):
        for first in range(begin, end, TURN):
            for name, agent in agents.items():
                began = time.process_time()
                agent.train(min(TURN, end - first))
                courses[name].cpu_s += time.process_time() - began
        for name, agent in agents.items():
            courses[name].returns.append(mean_return(agent))
            courses[name].updates = agent.updates
    return courses


def returns_of(courses: list[Course]) -> list[float]:
    """Final returns of all seeds."""
    return [course.returns[-1] for course in courses]


def updates_s(courses: list[Course]) -> float:
    """Updates per second of CPU time."""
    return sum(course.updates for course in courses) / sum(course.cpu_s for course in courses)


def difference(ours: list[float], theirs: list[float]) -> tuple[float, float]:
    """Difference of the mean returns over the seeds, and its standard error (0 for a single seed)."""
    several = len(ours) > 1
    error = math.sqrt((statistics.variance(ours) + statistics.variance(theirs)) / len(ours)) if several else 0.0
    return statistics.mean(ours) - statistics.mean(theirs), error


def table(seeds: list[int], courses: Courses) -> str:
    lines = ["| seed | " + " | ".join(courses) + " |", "|---|" + "---|" * len(courses)]
    ends = {name: returns_of(found) for name, found in courses.items()}
    lines += [_row(str(seed), [of_agent[i] for of_agent in ends.values()]) for i, seed in enumerate(seeds)]
    lines.append(_row("mean", [statistics.mean(of_agent) for of_agent in ends.values()]))
    halves = [statistics.mean(course.returns[0] for course in found) for found in courses.values()]
    lines.append(_row("mean half-way", halves))
    lines.append(_row("updates/s", [updates_s(found) for found in courses.values()]))
    for name, of_agent in ends.items():
        if name != THEIRS:
            by, error = difference(of_agent, ends[THEIRS])
            verdict = "at least as good" if by >= -error else "worse"
            lines.append(f"{name}: {by:+.1f} with a standard error of {error:.1f}: {verdict}")
    return "\n".join(lines)


def _row(title: str, values: list[float]) -> str:
    return f"| {title} | " + " | ".join(f"{value:.1f}" for value in values) + " |"


def as_json(courses: Courses) -> dict[str, dict[str, Any]]:
    """All results by agent."""
    found: dict[str, dict[str, Any]] = {}
    theirs = returns_of(courses[THEIRS])
    for name, of_agent in courses.items():
        by, error = difference(returns_of(of_agent), theirs)
        found[name] = {
            "returns": returns_of(of_agent),
            "mean": statistics.mean(returns_of(of_agent)),
            "half_way": [course.returns[0] for course in of_agent],
            "updates": [course.updates for course in of_agent],
            "updates_s": round(updates_s(of_agent), 1),
            "difference": by,
            "standard_error": error,
            "at_least_as_good": by >= -error,
        }
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--interactions", type=int, default=5000, help=f"of every agent, more than {2 * STARTS}")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--agents", nargs="+", choices=list(AGENTS)[:-1], default=list(AGENTS)[:-1], help="of ours")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    arguments = parser.parse_args()
    if arguments.interactions <= 2 * STARTS:
        parser.error(f"--interactions: expected more than {2 * STARTS}, got {arguments.interactions}")
    torch.set_num_threads(1)
    courses: Courses = {name: [] for name in [*arguments.agents, THEIRS]}
    for seed in arguments.seeds:
        for name, course in train_in_turns(seed, arguments.interactions, list(courses)).items():
            courses[name].append(course)
            print(f"seed {seed}, {name}: {course}", file=sys.stderr, flush=True)
    print(json.dumps(as_json(courses)) if arguments.json else table(arguments.seeds, courses))


if __name__ == "__main__":
    main()
