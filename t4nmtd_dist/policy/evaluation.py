"""Evaluates the global policy in greedy or sampled episodes from the true reset."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import TypeVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.action_modes import ActionMode
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.environments.batched import BatchedEnv, Observations
from t4nmtd_dist.environments.timed import make_task_env
from t4nmtd_dist.method.rewards import SymbolReader
from t4nmtd_dist.policy.global_policy import GlobalPolicy

PERTURBATION_ROUNDS = 100

Flags = NDArray[np.bool_]
T = TypeVar("T")


@dataclass(frozen=True)
class EvaluationResult:
    """Episodes of one evaluation.

    Attributes:
        success: bool [episodes], accepted within the horizon.
        lengths: int [episodes], steps until acceptance, error, the environment's end, or the horizon.
        returns: float [episodes], validation return: sum of rho(q') - rho(q) over steps with q' outside E.
        dfa_path: DFA states of the first episode, in order.
        redrawn: perturbed starts redrawn because they ended the episode.
    """

    success: Flags
    lengths: NDArray[np.int64]
    returns: NDArray[np.float64]
    dfa_path: list[int]
    redrawn: int = 0

    @property
    def success_rate(self) -> float:
        """Share of accepted episodes."""
        return float(self.success.mean())


class Evaluator:
    """Evaluates a task's policies in environments that it keeps open.

    Args:
        policy: any policy of the task, for its settings and automaton.
        episodes: episodes per evaluation, stepped together.
        seed: for resets, perturbations and sampled actions.
    """

    def __init__(self, policy: GlobalPolicy, episodes: int, *, seed: int) -> None:
        self._env: BatchedEnv = make_task_env(policy.config, episodes)
        self._reader = SymbolReader(policy.dfa, self._env.propositions)
        self._horizon = policy.config.environment.horizon
        self._rng = np.random.default_rng([seed, 3])
        self._sampling = np.random.default_rng([seed, 4])
        self._seeded = False

    def run(self, policy: GlobalPolicy, *, perturb: int = 0, actions: ActionMode | None = None) -> EvaluationResult:
        """Run one evaluation: every episode starts from the true reset with a new step counter.

        If the trace ends with the episode (docs/acceptance.md), the random actions of ``perturb`` count as steps.

        Args:
            policy: the acting policy.
            perturb: each episode begins with k random actions, k uniform in 0..perturb. If they end the episode, k and
                the actions are redrawn, which favours smaller k.
            actions: ``greedy`` or ``sampled``; None for the policy's own mode.

        Raises:
            PolicyError: if the policy was trained on observations of another size.
        """
        return finished(self.steps(policy, perturb=perturb, actions=actions))

    def steps(
        self, policy: GlobalPolicy, *, perturb: int = 0, actions: ActionMode | None = None
    ) -> Generator[None, None, EvaluationResult]:
        """``run`` as a generator that yields once per step, for interleaving with other work."""
        rows = np.arange(self._env.count)
        if perturb:
            observations, q, redrawn = self._perturbed_starts(policy, perturb)
        else:
            observations, q, redrawn = self._reset(), np.full(len(rows), policy.dfa.initial, np.int32), 0
        sampling = self._sampling if (actions or policy.mode) == "sampled" else None
        return (yield from self._episodes(policy, observations, q, redrawn, sampling))

    def state_dict(self) -> State:
        """State of the starts and sampled actions of the next evaluations, for a checkpoint."""
        env = self._env.state_dict() if self._seeded else None
        generators = {"rng": self._rng.bit_generator.state, "sampling": self._sampling.bit_generator.state}
        return {**generators, "seeded": self._seeded, "env": env}

    def load_state_dict(self, state: State) -> None:
        """Restore from the ``state_dict`` of an evaluator with the same task and ``episodes``."""
        self._rng.bit_generator.state, self._seeded = state["rng"], state["seeded"]
        if "sampling" in state:  # older checkpoints have none
            self._sampling.bit_generator.state = state["sampling"]
        if self._seeded:
            self._env.load_state_dict(state["env"])

    def _reset(self) -> Observations:
        seed = None if self._seeded else int(self._rng.integers(2**31))
        self._seeded = True
        return self._env.reset(np.arange(self._env.count), seed)

    def _episodes(
        self,
        policy: GlobalPolicy,
        observations: Observations,
        q: NDArray[np.int32],
        redrawn: int,
        sampling: np.random.Generator | None,
    ) -> Generator[None, None, EvaluationResult]:
        policy.check_fits(observations)
        count = len(q)
        policy.begin(count)
        accepting, error = _masks(policy)
        success, over = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        lengths, returns = np.zeros(count, np.int64), np.zeros(count)
        path = [int(q[0])]
        for _ in range(self._horizon):
            actions, known = policy.actions(observations, q, sampling)
            over |= ~known
            if over.all():
                break
            step = self._env.step(actions)
            q_next = np.where(over, q, policy.dfa.delta[q, self._reader.symbols(step.labels)]).astype(np.int32)
            returns += np.where(error[q_next], 0.0, policy.rho[q_next] - policy.rho[q])
            lengths += ~over
            success |= accepting[q_next] & ~over
            over = over | accepting[q_next] | error[q_next] | step.terminated | step.truncated
            observations, q = step.observations, q_next
            if path[-1] != q[0]:
                path.append(int(q[0]))
            yield
        return EvaluationResult(success, lengths, returns, path, redrawn)

    def _perturbed_starts(self, policy: GlobalPolicy, most: int) -> tuple[Observations, NDArray[np.int32], int]:
        """Start states after random actions that did not end the episode."""
        rows = list(range(self._env.count))
        snapshots: dict[int, tuple[NDArray[np.generic], int]] = {}
        redrawn = 0
        for _ in range(PERTURBATION_ROUNDS):
            missing = [row for row in rows if row not in snapshots]
            found = self._random_walks(policy, most)
            snapshots.update({row: found[row] for row in missing if row in found})
            redrawn += sum(row not in found for row in missing)
            if len(snapshots) == len(rows):
                states = [snapshots[row][0] for row in rows]
                q = np.array([snapshots[row][1] for row in rows], np.int32)
                return self._env.restore(np.array(rows), states), q, redrawn
        raise EnvError(f"{PERTURBATION_ROUNDS} rounds of {most} random actions each ended in error states")

    def _random_walks(self, policy: GlobalPolicy, most: int) -> dict[int, tuple[NDArray[np.generic], int]]:
        """Snapshot and DFA state after k random actions, for surviving rows."""
        count = self._env.count
        accepting, error = _masks(policy)
        self._reset()
        q, alive = np.full(count, policy.dfa.initial, np.int32), np.ones(count, np.bool_)
        k = self._rng.integers(most + 1, size=count)
        found: dict[int, tuple[NDArray[np.generic], int]] = {}
        for t in range(most + 1):
            due = np.flatnonzero(alive & (k == t))
            for row, state in zip(due, self._env.snapshot(due), strict=True):
                found[int(row)] = (state, int(q[row]))
            if t == most:
                break
            step = self._env.step(self._random_actions(count))
            q = policy.dfa.delta[q, self._reader.symbols(step.labels)]
            alive &= ~(step.terminated | step.truncated | accepting[q] | error[q])
        return found

    def _random_actions(self, count: int) -> NDArray[np.generic]:
        space = self._env.action_space
        if isinstance(space, gym.spaces.Discrete):
            return self._rng.integers(space.n, size=count)
        if isinstance(space, gym.spaces.Box):
            return self._rng.uniform(space.low, space.high, size=(count, *space.shape)).astype(np.float32)
        raise EnvError(f"action space {space} is not supported; expected Discrete or Box")


def finished(steps: Generator[None, None, T]) -> T:
    """Exhaust a generator and return its result."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: T = end.value
            return result


def _masks(policy: GlobalPolicy) -> tuple[Flags, Flags]:
    accepting, error = np.zeros(policy.dfa.states, np.bool_), np.zeros(policy.dfa.states, np.bool_)
    accepting[list(policy.dfa.accepting)] = True
    error[list(policy.dfa.error)] = True
    return accepting, error
