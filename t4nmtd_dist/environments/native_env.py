"""Adapter for vector environments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.state_dict import State, generator_states, set_generator_states
from t4nmtd_dist.environments.batched import EnvStep, Observations, Rows
from t4nmtd_dist.environments.observations import flattener
from t4nmtd_dist.environments.serialization import rng_state, set_rng_state
from t4nmtd_dist.environments.user_errors import call_user


class NativeBatchedEnv:
    """A Gymnasium vector environment that implements ``envs.protocol``."""

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
        """See ``BatchedEnv.state_dict``; ``generators`` are the environment's besides ``np_random``."""
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
