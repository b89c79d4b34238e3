"""Environments as the learners see them: N copies stepped together, with labels and exact snapshots.

Every environment here keeps one contract (``BatchedEnv``). A vector environment that keeps the contract of
``envs.protocol`` is used as it is; anything else is stepped copy by copy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.config import EnvironmentConfig
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.core.state_dict import State, generator_states, set_generator_states
from t4nmtd_dist.environments.observations import flattener
from t4nmtd_dist.environments.opening import Spec, find_spec
from t4nmtd_dist.environments.restoring import with_snapshots
from t4nmtd_dist.environments.serialization import rng_state, set_rng_state
from t4nmtd_dist.environments.single_env import EnvironmentCopy
from t4nmtd_dist.environments.user_errors import call_user, calls, described

Rows = NDArray[np.int64]
Observations = NDArray[np.float32]


@dataclass(frozen=True)
class EnvStep:
    """What one step of all N copies gave.

    Attributes:
        observations: float32 [N, d], after the step.
        labels: bool [N, P], the true propositions of each copy in the order of ``propositions``.
        terminated: bool [N], copies whose environment has ended.
        truncated: bool [N], copies whose environment cut the episode: a time-out, after which it cannot go on.
    """

    observations: Observations
    labels: NDArray[np.bool_]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class BatchedEnv(Protocol):
    """N copies of an environment.

    The loop it is meant for::

        observations = environment.reset(all_rows, seed)
        while True:
            step = environment.step(actions)
            observations[rows] = environment.restore(rows, states)      # rows that begin again
    """

    count: int
    propositions: tuple[str, ...]
    observation_size: int
    action_space: gym.Space[Any]
    categorical: NDArray[np.bool_]
    """Which numbers of an observation are one-hot, bool [d]."""

    @property
    def replayed(self) -> int:
        """Steps taken so far only to restore states; they are interactions like any other."""

    def reset(self, rows: Rows, seed: int | None = None) -> Observations:
        """The environment's own reset of some copies; float32 [len(rows), d]."""

    def restore(self, rows: Rows, states: Sequence[NDArray[Any]]) -> Observations:
        """Put some copies into snapshots; float32 [len(rows), d]."""

    def snapshot(self, rows: Rows) -> list[NDArray[Any]]:
        """The states of some copies, one flat array each."""

    def step(self, actions: NDArray[Any]) -> EnvStep:
        """Step every copy."""

    def state_dict(self) -> State:
        """Everything that decides the future of all copies, random generators included, for a checkpoint."""

    def load_state_dict(self, state: State) -> None:
        """Go on from a ``state`` of an environment with as many copies."""


def make_env(config: EnvironmentConfig, count: int, propositions: Sequence[str] = ()) -> BatchedEnv:
    """Open ``count`` copies of the configured environment.

    Args:
        config: the section ``[environment]``.
        count: N.
        propositions: all that may be reported, by environments that do not say so themselves.

    Raises:
        EnvError: if the environment is unknown, refuses its options, or lacks labels or snapshots.
    """
    spec = find_spec(config)
    if not config.labels and spec is not None and _keeps_vector_contract(spec):
        return NativeBatchedEnv(_open_vector(config, spec, count), config.leave_out)
    config = with_snapshots(config, propositions)
    return LoopedEnv([EnvironmentCopy(config, propositions) for _ in range(count)])


def _keeps_vector_contract(spec: Spec) -> bool:
    if spec.vector_entry_point is None:
        return False
    entry_point = spec.vector_entry_point
    made = gym.envs.registration.load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    return all(hasattr(made, name) for name in ("get_states", "set_states"))


def _open_vector(config: EnvironmentConfig, spec: Spec, count: int) -> Any:
    try:
        return gym.make_vec(spec.id, count, "vector_entry_point", **config.options)
    except (TypeError, ValueError) as error:
        text = f"environment {config.id!r} refused its options {config.options}: {error}{calls(error)}"
        raise EnvError(text) from None
    except (gym.error.Error, ImportError) as error:
        raise EnvError(f"environment {config.id!r}: {error}{calls(error)}") from None
    except Exception as error:  # whatever a user's code may raise
        text = f"making environment {config.id!r} with {config.options}: {described(error)}"
        raise EnvError(text) from error


class NativeBatchedEnv:
    """A Gymnasium vector environment that steps its copies itself (``envs.protocol``)."""

    replayed = 0

    def __init__(self, env: Any, leave_out: Sequence[str] = ()) -> None:
        self._env, self._who = env, f"environment {env.spec.id!r}"
        self.count = int(env.num_envs)
        self.propositions: tuple[str, ...] = tuple(env.propositions)
        flat = flattener(env.single_observation_space, leave_out)
        self.observation_size, self.categorical = flat.size, flat.categorical
        self.action_space: gym.Space[Any] = env.single_action_space

    def reset(self, rows: Rows, seed: int | None = None) -> Observations:
        """See ``BatchedEnv.reset``."""
        mask = np.zeros(self.count, dtype=np.bool_)
        mask[rows] = True
        options = {"reset_mask": mask}
        observations, _ = call_user(self._who, "reset()", self._env.reset, seed=seed, options=options)
        kept: Observations = observations[rows]
        return kept

    def restore(self, rows: Rows, states: Sequence[NDArray[Any]]) -> Observations:
        """See ``BatchedEnv.restore``."""
        stacked = np.stack(list(states))
        observations: Observations = call_user(self._who, "set_states()", self._env.set_states, rows, stacked)
        return observations

    def snapshot(self, rows: Rows) -> list[NDArray[Any]]:
        """See ``BatchedEnv.snapshot``."""
        return list(call_user(self._who, "get_states()", self._env.get_states, rows))

    def step(self, actions: NDArray[Any]) -> EnvStep:
        """See ``BatchedEnv.step``."""
        observations, _, terminated, truncated, info = call_user(self._who, "step()", self._env.step, actions)
        return EnvStep(observations, info["labels"], terminated, truncated)

    def state_dict(self) -> State:
        """See ``BatchedEnv.state_dict``; ``generators`` are those of the environment beside its ``np_random``."""
        return {
            "snapshots": self._env.get_states(np.arange(self.count)),
            "rng": rng_state(self._env),
            "generators": generator_states(self._generators),
        }

    def load_state_dict(self, state: State) -> None:
        """See ``BatchedEnv.load_state_dict``."""
        self._env.set_states(np.arange(self.count), state["snapshots"])
        set_rng_state(self._env, state["rng"])
        set_generator_states(self._generators, state["generators"])

    @property
    def _generators(self) -> list[np.random.Generator]:
        return list(getattr(self._env, "generators", ()))


class LoopedEnv:
    """Copies of an ordinary environment, one by one.

    A copy that has ended, or was cut, is not stepped again until it is reset or restored; its last step is repeated.
    """

    def __init__(self, copies: Sequence[EnvironmentCopy]) -> None:
        first = copies[0]
        self._copies = list(copies)
        self.count = len(self._copies)
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
        return sum(copy.replayed for copy in self._copies)

    def reset(self, rows: Rows, seed: int | None = None) -> Observations:
        """See ``BatchedEnv.reset``; copy ``i`` gets seed + i."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        seeds = [None if seed is None else seed + int(i) for i in rows]
        return self._begun(rows, [self._copies[i].reset(s) for i, s in zip(rows, seeds, strict=True)])

    def restore(self, rows: Rows, states: Sequence[NDArray[Any]]) -> Observations:
        """See ``BatchedEnv.restore``; what follows is thrown with new rng."""
        begun = self._begun(rows, [self._copies[i].set_state(s) for i, s in zip(rows, states, strict=True)])
        for i in rows:
            self._copies[i].reseed(int(self._rng.integers(2**31)))
        return begun

    def _begun(self, rows: Rows, firsts: list[Observations]) -> Observations:
        self._terminated[rows] = self._truncated[rows] = False
        self._observations[rows] = firsts
        begun: Observations = self._observations[rows]
        return begun

    def snapshot(self, rows: Rows) -> list[NDArray[Any]]:
        """See ``BatchedEnv.snapshot``."""
        return [self._copies[i].get_state() for i in rows]

    def step(self, actions: NDArray[Any]) -> EnvStep:
        """See ``BatchedEnv.step``."""
        for i in np.flatnonzero(~(self._terminated | self._truncated)):
            done = self._copies[i].step(actions[i])
            self._observations[i], self._labels[i] = done.observation, done.labels
            self._terminated[i], self._truncated[i] = done.terminated, done.truncated
        return EnvStep(self._observations.copy(), self._labels.copy(), self._terminated.copy(), self._truncated.copy())

    def state_dict(self) -> State:
        """See ``BatchedEnv.state_dict``."""
        return {
            "copies": [copy.state_dict() for copy in self._copies],
            "rng": self._rng.bit_generator.state,
            "last": {name: column.copy() for name, column in self._last().items()},
        }

    def load_state_dict(self, state: State) -> None:
        """See ``BatchedEnv.load_state_dict``."""
        for copy, saved in zip(self._copies, state["copies"], strict=True):
            copy.load_state_dict(saved)
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
