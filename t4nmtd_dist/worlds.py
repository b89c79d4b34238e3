"""Environments as the learners see them: N copies stepped together, with labels and exact snapshots.

Every world here keeps one contract (``BatchedWorld``). A Gymnasium environment with a vector entry point of its
own is used as it is; any other is stepped copy by copy.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.config import EnvironmentConfig
from t4nmtd_dist.errors import WorldError

Rows = NDArray[np.int64]
Observations = NDArray[np.float32]


@dataclass(frozen=True)
class WorldStep:
    """What one step of all N copies gave.

    Attributes:
        observations: float32 [N, d], after the step.
        labels: bool [N, P], the true propositions of each copy in the order of ``propositions``.
        terminated: bool [N], copies whose environment has ended.
    """

    observations: Observations
    labels: NDArray[np.bool_]
    terminated: NDArray[np.bool_]


class BatchedWorld(Protocol):
    """N copies of an environment.

    The loop it is meant for::

        observations = world.reset(all_rows, seed)
        while True:
            step = world.step(actions)
            observations[rows] = world.restore(rows, states)      # rows that begin again
    """

    count: int
    propositions: tuple[str, ...]
    observation_size: int
    action_space: gym.Space[Any]

    def reset(self, rows: Rows, seed: int | None = None) -> Observations:
        """The environment's own reset of some copies; float32 [len(rows), d]."""

    def restore(self, rows: Rows, states: Sequence[NDArray[Any]]) -> Observations:
        """Put some copies into snapshots; float32 [len(rows), d]."""

    def snapshot(self, rows: Rows) -> list[NDArray[Any]]:
        """The states of some copies, one flat array each."""

    def step(self, actions: NDArray[Any]) -> WorldStep:
        """Step every copy."""


def make_world(config: EnvironmentConfig, count: int) -> BatchedWorld:
    """Open ``count`` copies of the configured environment.

    Raises:
        WorldError: if the environment is unknown, refuses its options, or lacks labels or snapshots.
    """
    module, _, name = config.id.rpartition(":")
    try:
        if module:
            importlib.import_module(module)
        if gym.spec(name).vector_entry_point is not None:
            return VectorWorld(gym.make_vec(name, count, "vector_entry_point", **config.options))
        return LoopedWorld([gym.make(name, **config.options).unwrapped for _ in range(count)])
    except (gym.error.Error, ImportError) as error:
        raise WorldError(f"environment {config.id!r}: {error}") from None
    except (TypeError, ValueError) as error:
        raise WorldError(f"environment {config.id!r} refused its options {config.options}: {error}") from None


def _require(world: object, names: Sequence[str]) -> None:
    missing = [name for name in names if not hasattr(world, name)]
    if missing:
        raise WorldError(f"{type(world).__name__} lacks {', '.join(missing)}; see envs/protocol.py for the contract")


def _vector_size(space: gym.Space[Any]) -> int:
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        raise WorldError(f"observation space {space} is not supported; expected a Box of one dimension")
    return space.shape[0]


class VectorWorld:
    """A Gymnasium vector environment that steps its copies itself (``envs.protocol``)."""

    def __init__(self, env: Any) -> None:
        _require(env, ("propositions", "get_states", "set_states"))
        self._env = env
        self.count = int(env.num_envs)
        self.propositions: tuple[str, ...] = tuple(env.propositions)
        self.observation_size = _vector_size(env.single_observation_space)
        self.action_space: gym.Space[Any] = env.single_action_space

    def reset(self, rows: Rows, seed: int | None = None) -> Observations:
        """See ``BatchedWorld.reset``."""
        mask = np.zeros(self.count, dtype=np.bool_)
        mask[rows] = True
        observations, _ = self._env.reset(seed=seed, options={"reset_mask": mask})
        kept: Observations = observations[rows]
        return kept

    def restore(self, rows: Rows, states: Sequence[NDArray[Any]]) -> Observations:
        """See ``BatchedWorld.restore``."""
        observations: Observations = self._env.set_states(rows, np.stack(list(states)))
        return observations

    def snapshot(self, rows: Rows) -> list[NDArray[Any]]:
        """See ``BatchedWorld.snapshot``."""
        return list(self._env.get_states(rows))

    def step(self, actions: NDArray[Any]) -> WorldStep:
        """See ``BatchedWorld.step``."""
        observations, _, terminated, _, info = self._env.step(actions)
        return WorldStep(observations, info["labels"], terminated)


class LoopedWorld:
    """Copies of an ordinary environment with ``get_state``, ``set_state`` and ``info["labels"]``, one by one.

    A copy that has terminated is not stepped again until it is reset or restored; its last step is repeated.
    """

    def __init__(self, envs: Sequence[Any]) -> None:
        _require(envs[0], ("propositions", "get_state", "set_state"))
        self._envs = list(envs)
        self.count = len(self._envs)
        self.propositions: tuple[str, ...] = tuple(envs[0].propositions)
        self.observation_size = _vector_size(envs[0].observation_space)
        self.action_space: gym.Space[Any] = envs[0].action_space
        self._observations = np.zeros((self.count, self.observation_size), dtype=np.float32)
        self._labels = np.zeros((self.count, len(self.propositions)), dtype=np.bool_)
        self._terminated = np.zeros(self.count, dtype=np.bool_)

    def reset(self, rows: Rows, seed: int | None = None) -> Observations:
        """See ``BatchedWorld.reset``; copy ``i`` gets seed + i."""
        seeds = [None if seed is None else seed + int(i) for i in rows]
        firsts = [self._envs[i].reset(seed=s)[0] for i, s in zip(rows, seeds, strict=True)]
        return self._begun(rows, firsts)

    def restore(self, rows: Rows, states: Sequence[NDArray[Any]]) -> Observations:
        """See ``BatchedWorld.restore``."""
        return self._begun(rows, [self._envs[i].set_state(s) for i, s in zip(rows, states, strict=True)])

    def _begun(self, rows: Rows, firsts: list[Any]) -> Observations:
        self._terminated[rows] = False
        self._observations[rows] = firsts
        begun: Observations = self._observations[rows]
        return begun

    def snapshot(self, rows: Rows) -> list[NDArray[Any]]:
        """See ``BatchedWorld.snapshot``."""
        return [self._envs[i].get_state() for i in rows]

    def step(self, actions: NDArray[Any]) -> WorldStep:
        """See ``BatchedWorld.step``."""
        for i in np.flatnonzero(~self._terminated):
            observation, _, terminated, _, info = self._envs[i].step(actions[i])
            self._observations[i] = observation
            self._labels[i] = [name in info["labels"] for name in self.propositions]
            self._terminated[i] = terminated
        return WorldStep(self._observations.copy(), self._labels.copy(), self._terminated.copy())
