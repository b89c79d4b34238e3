"""One environment with vector observations, labels and snapshots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from t4nmtd_dist.core.config import EnvironmentConfig
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.environments.labels import LabelReader
from t4nmtd_dist.environments.observations import Vector, flattener
from t4nmtd_dist.environments.opening import open_environment
from t4nmtd_dist.environments.serialization import rng_state, set_rng_state
from t4nmtd_dist.environments.snapshots import make_snapshots
from t4nmtd_dist.environments.user_errors import call_user


class SingleStep(NamedTuple):
    """One step: observation float32 [d], labels bool [P], terminated, truncated."""

    observation: Vector
    labels: NDArray[np.bool_]
    terminated: bool
    truncated: bool


class SingleEnv:
    """An environment as configured by a task file.

    Args:
        config: the section ``[environment]``, with resolved ``snapshots`` (see ``snapshot_choice.with_snapshots``).
        propositions: all that may be reported; overridden by the environment's own ``propositions`` if there is no
            labelling function.
        render_mode: passed to the environment.

    Raises:
        EnvError: if the environment cannot be opened, or has an unsupported space.
    """

    def __init__(
        self, config: EnvironmentConfig, propositions: Sequence[str], *, render_mode: str | None = None
    ) -> None:
        self._who = f"environment {config.id!r}"
        self.env: Any = open_environment(config, render_mode=render_mode)
        flat = flattener(self.env.observation_space, config.leave_out)
        self.observation_size, self.categorical, self.parts = flat.size, flat.categorical, flat.parts
        self.action_space = checked_action_space(self.env.action_space)
        own = None if config.labels else getattr(self.env.unwrapped, "propositions", None)
        self._labels = LabelReader(config, propositions if own is None else own)
        self.propositions = self._labels.propositions
        self._flatten = flat.flatten
        adapter = "own" if config.snapshots == "auto" else config.snapshots
        self._snapshots = call_user(
            self._who,
            "reset() or get_state()",
            make_snapshots,
            self.env,
            adapter,
            flat,
            config.snapshot_bytes,
            config.horizon,
        )

    @property
    def replayed(self) -> int:
        """Steps taken to restore states."""
        return self._snapshots.replayed

    def reset(self, seed: int | None) -> Vector:
        """Begin an episode; returns its first observation."""
        seen = call_user(self._who, "reset()", self._snapshots.reset, seed)
        return _finite(self._flatten(seen), "the observation of reset()")

    def step(self, action: Any) -> SingleStep:
        """Act once."""
        action = self._action(action)
        seen, _, terminated, truncated, info = call_user(self._who, "step()", self.env.step, action)
        observation = _finite(self._flatten(seen), "the observation of step()")
        cut = self._snapshots.acted(action, observation)
        return SingleStep(observation, self._labels.row(seen, info), bool(terminated), bool(truncated) or cut)

    def _action(self, action: Any) -> Any:
        space = self.action_space
        return int(action) if isinstance(space, spaces.Discrete) else np.asarray(action, space.dtype)

    def get_state(self) -> NDArray[Any]:
        """A snapshot."""
        return call_user(self._who, "get_state()", self._snapshots.get)

    def set_state(self, state: NDArray[Any]) -> Vector:
        """Restore a snapshot; returns its observation.

        Raises:
            EnvError: if it is not a snapshot of this environment.
        """
        observation = call_user(self._who, "set_state()", self._snapshots.set, state)
        return _finite(observation, "the observation after restoring a state")

    def render(self) -> Any:
        """The rendered frame."""
        return call_user(self._who, "render()", self.env.render)

    def reseed(self, seed: int) -> None:
        """Seed the environment's random generator."""
        self._snapshots.reseed(seed)

    def state_dict(self) -> State:
        """Complete state, random generator included, for a checkpoint."""
        return {
            "snapshot": self._snapshots.get(),
            "rng": rng_state(self.env),
            "bookkeeping": self._snapshots.bookkeeping(),
        }

    def load_state_dict(self, state: State) -> None:
        """Restore from ``state_dict``, without counting replayed steps again."""
        replayed = self._snapshots.replayed
        self._snapshots.set(state["snapshot"])
        if self._snapshots.replayed != replayed:
            self._snapshots.replayed = replayed
        set_rng_state(self.env, state["rng"])
        self._snapshots.load_bookkeeping(state["bookkeeping"])


def _finite(observation: Vector, which: str) -> Vector:
    if not np.isfinite(observation).all():
        raise EnvError(f"{which} holds NaN or infinity, from which nothing can be learned")
    return observation


def checked_action_space(space: Any) -> Any:
    """The space, if it is Box or Discrete starting at 0.

    Raises:
        EnvError: for any other space.
    """
    if isinstance(space, spaces.Box) or (isinstance(space, spaces.Discrete) and space.start == 0):
        return space
    raise EnvError(f"action space {space} is not supported; expected Box, or Discrete from 0")
