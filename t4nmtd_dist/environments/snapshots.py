"""Snapshots of environments: flat arrays that any process with the same environment can restore.

Three ways, beside environments that keep the whole contract of our own worlds: ``OwnState`` (their ``get_state``
and ``set_state``), ``AttributeState`` (their attributes, with MuJoCo's integration state where there is one), and
``Replay`` (a seed and the actions since). docs/decisions/010 says why these, and what is not in a snapshot: the
environment's own dice ``np_random``. Every attempt throws them anew.
"""

from __future__ import annotations

from typing import Any, Literal, Protocol

import gymnasium as gym
import msgpack
import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.environments.attribute_state import CannotRestoreError, pack, restored
from t4nmtd_dist.environments.observations import Flattener, Vector
from t4nmtd_dist.environments.opening import Env
from t4nmtd_dist.errors import WorldError

Adapter = Literal["own", "mujoco", "attributes", "replay"]
ADAPTERS: tuple[Adapter, ...] = ("own", "mujoco", "attributes", "replay")

_LENGTH = np.dtype("<u4")
_DICE = ("_np_random", "_np_random_seed")
_OWN, _MUJOCO = "own", "mujoco"


class Snapshots(Protocol):
    """How one environment is put into earlier states."""

    replayed: int

    def reset(self, seed: int | None) -> Any:
        """Reset the environment; its observation."""

    def acted(self, action: Any, observation: Vector) -> bool:
        """Note a step; True if no more can be noted, so that the episode must be cut."""

    def get(self) -> NDArray[Any]:
        """A snapshot of the state now."""

    def set(self, state: NDArray[Any]) -> Vector:
        """Restore a snapshot; the observation there."""

    def throw_new_dice(self, seed: int) -> None:
        """Give the environment's random generator a new state."""


def keeps_contract(env: Env) -> bool:
    """Whether the environment is like our own worlds: see ``envs.protocol.SnapshotEnv``."""
    return all(hasattr(env, name) for name in ("propositions", "get_state", "set_state"))


def has_own_state(env: Env) -> bool:
    """Whether the environment or something that it wraps has ``get_state`` and ``set_state``."""
    return _own_layer(env) is not None


def is_mujoco(env: Env) -> bool:
    """Whether the environment has a MuJoCo ``model`` and ``data``."""
    data = getattr(env.unwrapped, "data", None)
    return hasattr(env.unwrapped, "model") and type(data).__module__.startswith("mujoco")


def make_snapshots(env: Env, adapter: Adapter, flattener: Flattener, *, room: int, horizon: int) -> Snapshots:
    """The adapter of a name.

    Args:
        env: the environment.
        adapter: its name.
        flattener: of its observations.
        room: bytes of one snapshot; 0 for as many as it happens to need.
        horizon: most steps of a replay.

    Raises:
        WorldError: if the environment does not have what the adapter needs.
    """
    if adapter == "replay":
        return Replay(env, flattener, horizon)
    if adapter == "own" and keeps_contract(env):
        return Contract(env, flattener)
    needed = {"own": has_own_state, "mujoco": is_mujoco}.get(adapter)
    if needed is not None and not needed(env):
        raise WorldError(f'environment.snapshots = "{adapter}" does not fit {env}: it lacks what that needs')
    return AttributeState(env, adapter, flattener, room)


def _own_layer(env: Any) -> Any:
    while True:
        if callable(getattr(env, "get_state", None)) and callable(getattr(env, "set_state", None)):
            return env
        if not isinstance(env, gym.Wrapper):
            return None
        env = env.env


class Contract:
    """An environment of our own kind: its snapshots are its own affair, dice included."""

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
        state: NDArray[Any] = self._env.get_state()
        return state

    def set(self, state: NDArray[Any]) -> Vector:
        """See ``Snapshots.set``."""
        return self._flattener.flatten(self._env.set_state(state))

    def throw_new_dice(self, seed: int) -> None:
        """Leave them as they are."""


class AttributeState:
    """Attributes of the environment and of its wrappers, written down as bytes.

    A snapshot holds the observation and those attributes that differ from a fresh environment after ``reset(seed=0)``:
    tables that never change cost nothing. What the environment keeps elsewhere comes beside them: the array of its
    own ``get_state`` (then only the wrappers around it are looked into), or MuJoCo's integration state.

    Args:
        env: the environment.
        adapter: "own", "mujoco" or "attributes".
        flattener: of its observations.
        room: bytes of one snapshot; 0 for as many as it happens to need.
    """

    replayed = 0

    def __init__(self, env: Any, adapter: Adapter, flattener: Flattener, room: int) -> None:
        self._env, self._flattener, self._room = env, flattener, room
        self._own = _own_layer(env) if adapter == "own" else None
        self._mujoco = _MujocoState(env.unwrapped) if adapter == "mujoco" else None
        self._layers = self._layers_outside(self._own)
        self._observation = self._flattener.flatten(env.reset(seed=0)[0])
        self._fresh = self._written()

    def _layers_outside(self, stop: Any) -> list[Any]:
        layers, layer = [], self._env
        while layer is not stop:
            layers.append(layer)
            if not isinstance(layer, gym.Wrapper):
                break
            layer = layer.env
        return layers

    def reset(self, seed: int | None) -> Any:
        """See ``Snapshots.reset``."""
        observation = self._env.reset(seed=seed)[0]
        self._observation = self._flattener.flatten(observation)
        return observation

    def acted(self, action: Any, observation: Vector) -> bool:
        """See ``Snapshots.acted``."""
        self._observation = observation
        return False

    def get(self) -> NDArray[np.uint8]:
        """See ``Snapshots.get``."""
        written = self._written()
        changed = {key: code for key, code in written.items() if self._fresh.get(key) != code}
        gone = [key for key in self._fresh if key not in written]
        data: bytes = msgpack.packb([self._observation.tobytes(), changed, gone])
        return _padded(data, self._room)

    def set(self, state: NDArray[Any]) -> Vector:
        """See ``Snapshots.set``."""
        try:
            observation, changed, gone = msgpack.unpackb(_unpadded(state), strict_map_key=False)
            wanted = {key: code for key, code in {**self._fresh, **changed}.items() if key not in gone}
            self._observation = np.frombuffer(observation, np.float32).reshape(self._flattener.size)
            self._restore(wanted)
        except CannotRestoreError:
            raise
        except (ValueError, TypeError, KeyError, IndexError, AttributeError) as error:
            raise WorldError(f"no snapshot of {self._env}: {type(error).__name__}: {error}") from None
        return self._observation

    def _attributes(self) -> dict[str, tuple[dict[str, Any], str]]:
        """Every attribute by key, as the dictionary that holds it and its name there."""
        return {
            f"{depth}.{name}": (vars(layer), name)
            for depth, layer in enumerate(self._layers)
            for name in vars(layer)
            if name not in _DICE and not (name == "env" and isinstance(layer, gym.Wrapper))
        }

    def _written(self) -> dict[str, bytes]:
        left = frozenset(map(id, [*self._layers, self._own, getattr(self._env.unwrapped, "_np_random", None)]))
        found = {key: pack(held[name], leave=left) for key, (held, name) in self._attributes().items()}
        if self._own is not None:
            found[_OWN] = pack(self._own.get_state())
        if self._mujoco is not None:
            found[_MUJOCO] = self._mujoco.get()
        return found

    def _restore(self, wanted: dict[str, bytes]) -> None:
        if self._own is not None:
            self._own.set_state(restored(wanted[_OWN], None))
        attributes = self._attributes()
        for key in [key for key in attributes if key not in wanted]:
            held, name = attributes[key]
            del held[name]
        for key, code in wanted.items():
            if key not in (_OWN, _MUJOCO):
                depth, _, name = key.partition(".")
                held = vars(self._layers[int(depth)])
                held[name] = restored(code, held.get(name))
        if self._mujoco is not None:
            self._mujoco.set(wanted[_MUJOCO])

    def throw_new_dice(self, seed: int) -> None:
        """See ``Snapshots.throw_new_dice``."""
        throw_new_dice(self._env, seed)


class _MujocoState:
    """MuJoCo's integration state: positions, velocities, controls, forces, and the solver's warm start."""

    def __init__(self, env: Any) -> None:
        import mujoco

        self._mujoco, self._env = mujoco, env
        self._kind = mujoco.mjtState.mjSTATE_INTEGRATION

    def get(self) -> bytes:
        state = np.empty(self._mujoco.mj_stateSize(self._env.model, self._kind))
        self._mujoco.mj_getState(self._env.model, self._env.data, state, self._kind)
        return state.tobytes()

    def set(self, data: bytes) -> None:
        """Restore, with what is derived from positions (sites, sensors) as of them."""
        state = np.frombuffer(data, np.float64).copy()
        self._mujoco.mj_setState(self._env.model, self._env.data, state, self._kind)
        self._mujoco.mj_forward(self._env.model, self._env.data)
        self._mujoco.mj_setState(self._env.model, self._env.data, state, self._kind)


class Replay:
    """A seed and the actions since: restoring resets the environment and acts again.

    Episodes are cut after ``horizon`` steps, which keeps snapshots of one size. New dice are part of the record.

    Attributes:
        replayed: steps that restoring has taken; they count as interactions.
    """

    def __init__(self, env: Any, flattener: Flattener, horizon: int) -> None:
        self._env, self._flattener, self._horizon = env, flattener, horizon
        space = env.action_space
        self._record = np.dtype([("dice", "<u4"), ("action", space.dtype.newbyteorder("<"), space.shape)])
        self._seeds = np.random.default_rng(0)
        self._history: list[tuple[int, Any]] = []
        self._seed = self._dice = 0
        self.replayed = 0
        self._observation = self._flattener.flatten(self.reset(0))

    def reset(self, seed: int | None) -> Any:
        """See ``Snapshots.reset``; without a seed, one is drawn."""
        if seed is not None:
            self._seeds = np.random.default_rng(seed)
        self._seed = int(self._seeds.integers(2**31)) if seed is None else seed
        self._history, self._dice = [], 0
        return self._env.reset(seed=self._seed)[0]

    def acted(self, action: Any, observation: Vector) -> bool:
        """See ``Snapshots.acted``."""
        self._history.append((self._dice, action))
        self._dice = 0
        return len(self._history) >= self._horizon

    def get(self) -> NDArray[np.uint8]:
        """See ``Snapshots.get``."""
        data = self._seed.to_bytes(8, "little") + np.array(self._history, self._record).tobytes()
        return _padded(data, 8 + self._horizon * self._record.itemsize)

    def set(self, state: NDArray[Any]) -> Vector:
        """See ``Snapshots.set``."""
        try:
            data = _unpadded(state)
            history = np.frombuffer(data[8:], self._record)
        except ValueError as error:
            raise WorldError(f"no snapshot of {self._env}: {error}") from None
        observation = self.reset(int.from_bytes(data[:8], "little"))
        for dice, action in history:
            if dice:
                self.throw_new_dice(int(dice))
            observation = self._env.step(action if self._env.action_space.shape else int(action))[0]
            self.acted(action, self._observation)
        self.replayed += len(history)
        return self._flattener.flatten(observation)

    def throw_new_dice(self, seed: int) -> None:
        """See ``Snapshots.throw_new_dice``."""
        self._dice = seed % (2**32 - 1) + 1
        throw_new_dice(self._env, self._dice)


def throw_new_dice(env: Env, seed: int) -> None:
    """Seed the environment's ``np_random`` where it is, so that all who hold it see the change."""
    fresh = np.random.default_rng(seed)
    held = env.unwrapped.np_random
    if type(held.bit_generator) is type(fresh.bit_generator):
        held.bit_generator.state = fresh.bit_generator.state
    else:
        env.unwrapped.np_random = fresh


def _padded(data: bytes, room: int) -> NDArray[np.uint8]:
    """Length, data, and zeros up to ``room`` bytes of data."""
    if room and len(data) > room:
        raise WorldError(
            f"a snapshot takes {len(data)} bytes, and the task has room for {room}: "
            'set environment.snapshot_bytes higher, or environment.snapshots = "replay"'
        )
    array = np.zeros(_LENGTH.itemsize + max(room, len(data)), np.uint8)
    array[:4].view(_LENGTH)[0] = len(data)
    array[4 : 4 + len(data)] = np.frombuffer(data, np.uint8)
    return array


def _unpadded(state: NDArray[Any]) -> bytes:
    if state.dtype != np.uint8 or state.ndim != 1 or len(state) < _LENGTH.itemsize:
        raise ValueError(f"expected uint8 [n], got {state.dtype} {state.shape}")
    length = int(np.ascontiguousarray(state[:4]).view(_LENGTH)[0])
    if length > len(state) - 4:
        raise ValueError(f"{length} bytes announced, {len(state) - 4} came")
    return state[4 : 4 + length].tobytes()
