"""Environment snapshots: flat arrays that any process with the same environment can restore.

``OwnSnapshots`` serves environments that implement ``envs.protocol``, such as the bundled ones. Others use
``AttributeSnapshots`` (attributes, plus ``get_state`` or MuJoCo's integration state) or ``ActionReplay`` (a seed and
the actions since); see docs/decisions/010. Snapshots exclude ``np_random``: every rollout reseeds it.
"""

from __future__ import annotations

from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.environments.action_replay import ActionReplay
from t4nmtd_dist.environments.attribute_snapshots import AttributeSnapshots, own_layer
from t4nmtd_dist.environments.observations import Flattener, Vector
from t4nmtd_dist.environments.opening import Env
from t4nmtd_dist.environments.user_errors import calls

Adapter = Literal["own", "mujoco", "attributes", "replay"]
ADAPTERS: tuple[Adapter, ...] = ("own", "mujoco", "attributes", "replay")


class Snapshots(Protocol):
    """Saves and restores the state of one environment."""

    replayed: int

    def reset(self, seed: int | None) -> Any:
        """Reset the environment; returns its observation."""

    def acted(self, action: Any, observation: Vector) -> bool:
        """Record a step; True if the episode must be cut because the record is full."""

    def get(self) -> NDArray[Any]:
        """A snapshot of the current state."""

    def set(self, state: NDArray[Any]) -> Vector:
        """Restore a snapshot; returns its observation."""

    def reseed(self, seed: int) -> None:
        """Seed the environment's random generator."""

    def bookkeeping(self) -> State:
        """The adapter's state besides the environment's, for a checkpoint."""

    def load_bookkeeping(self, state: State) -> None:
        """Restore from ``bookkeeping``, after restoring the snapshot taken with it."""


def keeps_contract(env: Env) -> bool:
    """Whether the environment implements ``envs.protocol.SnapshotEnv``."""
    return all(hasattr(env, name) for name in ("propositions", "get_state", "set_state"))


def has_own_state(env: Env) -> bool:
    """Whether the environment or a layer inside it has ``get_state`` and ``set_state``."""
    return own_layer(env) is not None


def is_mujoco(env: Env) -> bool:
    """Whether the environment has a MuJoCo ``model`` and ``data``."""
    data = getattr(env.unwrapped, "data", None)
    return hasattr(env.unwrapped, "model") and type(data).__module__.startswith("mujoco")


def make_snapshots(env: Env, adapter: Adapter, flattener: Flattener, snapshot_bytes: int, horizon: int) -> Snapshots:
    """Create an adapter; ``snapshot_bytes`` 0 means no padding, ``horizon`` limits a replay.

    Raises:
        EnvError: if the environment lacks what the adapter needs.
    """
    if adapter == "replay":
        return ActionReplay(env, flattener, horizon)
    if adapter == "own" and keeps_contract(env):
        return OwnSnapshots(env, flattener)
    needed = {"own": has_own_state, "mujoco": is_mujoco}.get(adapter)
    if needed is not None and not needed(env):
        raise EnvError(f'environment.snapshots = "{adapter}" does not fit {env}: it lacks what that needs')
    return AttributeSnapshots(env, adapter, flattener, snapshot_bytes)


class OwnSnapshots:
    """Snapshots of an environment that implements ``envs.protocol``."""

    replayed = 0

    def __init__(self, env: Any, flattener: Flattener) -> None:
        self._env, self._flattener = env, flattener

    def reset(self, seed: int | None) -> Any:
        """See ``Snapshots.reset``."""
        return self._env.reset(seed=seed)[0]

    def acted(self, action: Any, observation: Vector) -> bool:
        """See ``Snapshots.acted``."""
        return False

    def get(self) -> NDArray[Any]:
        """See ``Snapshots.get``."""
        state = self._env.get_state()
        if not isinstance(state, np.ndarray) or state.ndim != 1:
            shape = f" of shape {state.shape}" if isinstance(state, np.ndarray) else ""
            found = f"{type(state).__name__}{shape}"
            raise EnvError(f"get_state() of {self._env} returned {found}; expected a flat NumPy array, shape (n,)")
        return state

    def set(self, state: NDArray[Any]) -> Vector:
        """See ``Snapshots.set``."""
        try:
            return self._flattener.flatten(self._env.set_state(state))
        except ValueError as error:
            raise EnvError(f"{self._env}: {error}{calls(error)}") from None

    def reseed(self, seed: int) -> None:
        """Do nothing: the generator belongs to the environment's own state."""

    def bookkeeping(self) -> State:
        """Empty."""
        return {}

    def load_bookkeeping(self, state: State) -> None:
        """Nothing to load."""
