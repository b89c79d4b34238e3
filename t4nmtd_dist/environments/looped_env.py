"""N ordinary environments stepped in a loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.environments.batched import EnvStep, Observations, Rows
from t4nmtd_dist.environments.single_env import SingleEnv


class LoopedEnv:
    """N ordinary environments, stepped one by one.

    A terminated or truncated environment repeats its last step until it is reset or restored.
    """

    def __init__(self, envs: Sequence[SingleEnv]) -> None:
        first = envs[0]
        self._envs = list(envs)
        self.count = len(self._envs)
        self.propositions: tuple[str, ...] = first.propositions
        self.observation_size, self.categorical = first.observation_size, first.categorical
        self.action_space: gym.Space[Any] = first.action_space
        self._rng = np.random.default_rng(0)
        self._observations = np.zeros((self.count, self.observation_size), dtype=np.float32)
        self._labels = np.zeros((self.count, len(self.propositions)), dtype=np.bool_)
        self._terminated = np.zeros(self.count, dtype=np.bool_)
        self._truncated = np.zeros(self.count, dtype=np.bool_)

    @property
    def replayed(self) -> int:
        """See ``BatchedEnv.replayed``."""
        return sum(env.replayed for env in self._envs)

    def reset(self, rows: Rows, seed: int | None = None) -> Observations:
        """See ``BatchedEnv.reset``; environment ``i`` gets seed + i."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        seeds = [None if seed is None else seed + int(i) for i in rows]
        return self._begun(rows, [self._envs[i].reset(s) for i, s in zip(rows, seeds, strict=True)])

    def restore(self, rows: Rows, states: Sequence[NDArray[Any]]) -> Observations:
        """See ``BatchedEnv.restore``; reseeds every restored environment."""
        begun = self._begun(rows, [self._envs[i].set_state(s) for i, s in zip(rows, states, strict=True)])
        for i in rows:
            self._envs[i].reseed(int(self._rng.integers(2**31)))
        return begun

    def _begun(self, rows: Rows, firsts: list[Observations]) -> Observations:
        self._terminated[rows] = self._truncated[rows] = False
        self._observations[rows] = firsts
        begun: Observations = self._observations[rows]
        return begun

    def snapshot(self, rows: Rows) -> list[NDArray[Any]]:
        """See ``BatchedEnv.snapshot``."""
        return [self._envs[i].get_state() for i in rows]

    def step(self, actions: NDArray[Any]) -> EnvStep:
        """See ``BatchedEnv.step``."""
        for i in np.flatnonzero(~(self._terminated | self._truncated)):
            done = self._envs[i].step(actions[i])
            self._observations[i], self._labels[i] = done.observation, done.labels
            self._terminated[i], self._truncated[i] = done.terminated, done.truncated
        return EnvStep(self._observations.copy(), self._labels.copy(), self._terminated.copy(), self._truncated.copy())

    def state_dict(self) -> State:
        """See ``BatchedEnv.state_dict``."""
        return {
            "copies": [env.state_dict() for env in self._envs],
            "rng": self._rng.bit_generator.state,
            "last": {name: column.copy() for name, column in self._last().items()},
        }

    def load_state_dict(self, state: State) -> None:
        """See ``BatchedEnv.load_state_dict``."""
        for env, saved in zip(self._envs, state["copies"], strict=True):
            env.load_state_dict(saved)
        self._rng.bit_generator.state = state["rng"]
        for name, column in self._last().items():
            column[:] = state["last"][name]

    def _last(self) -> dict[str, NDArray[Any]]:
        return {
            "observations": self._observations,
            "labels": self._labels,
            "terminated": self._terminated,
            "truncated": self._truncated,
        }
