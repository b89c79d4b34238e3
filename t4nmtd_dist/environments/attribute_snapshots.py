"""Snapshots of an environment's attributes and of state kept elsewhere."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import msgpack
import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import EnvError, T4NMTDError
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.environments.observations import Flattener, Vector
from t4nmtd_dist.environments.serialization import padded, reseed, unpadded
from t4nmtd_dist.environments.state_decoding import decode_state
from t4nmtd_dist.environments.state_encoding import encode_state
from t4nmtd_dist.environments.user_errors import call_user

_RNG = ("_np_random", "_np_random_seed")
_OWN, _MUJOCO = "own", "mujoco"


def own_layer(env: Any) -> Any:
    """The outermost layer of a wrapped environment with ``get_state`` and ``set_state``, or None."""
    while True:
        if callable(getattr(env, "get_state", None)) and callable(getattr(env, "set_state", None)):
            return env
        if not isinstance(env, gym.Wrapper):
            return None
        env = env.env


class AttributeSnapshots:
    """Snapshots of the attributes of an environment and its wrappers.

    A snapshot holds the observation and the attributes that differ from a fresh environment after ``reset(seed=0)``, so
    constant tables cost nothing. It adds the array of the environment's ``get_state`` (then only the wrappers around
    that layer are read), or MuJoCo's integration state.

    Args:
        env: the environment.
        adapter: "own", "mujoco" or "attributes".
        flattener: of its observations.
        snapshot_bytes: size of a snapshot; 0 for no padding.
    """

    replayed = 0

    def __init__(self, env: Any, adapter: str, flattener: Flattener, snapshot_bytes: int) -> None:
        self._env, self._flattener, self._snapshot_bytes = env, flattener, snapshot_bytes
        self._own = own_layer(env) if adapter == "own" else None
        self._mujoco = _MujocoState(env.unwrapped) if adapter == "mujoco" else None
        self._layers = self._layers_outside(self._own)
        self._observation = self._flattener.flatten(env.reset(seed=0)[0])
        self._fresh = self._encoded()

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
        encoded = self._encoded()
        changed = {key: code for key, code in encoded.items() if self._fresh.get(key) != code}
        gone = [key for key in self._fresh if key not in encoded]
        data: bytes = msgpack.packb([self._observation.tobytes(), changed, gone])
        return padded(data, self._snapshot_bytes)

    def set(self, state: NDArray[Any]) -> Vector:
        """See ``Snapshots.set``."""
        try:
            observation, changed, gone = msgpack.unpackb(unpadded(state), strict_map_key=False)
            wanted = {key: code for key, code in {**self._fresh, **changed}.items() if key not in gone}
            self._observation = np.frombuffer(observation, np.float32).reshape(self._flattener.size)
            self._restore(wanted)
        except T4NMTDError:
            raise
        except (ValueError, TypeError, KeyError, IndexError, AttributeError) as error:
            raise EnvError(f"no snapshot of {self._env}: {type(error).__name__}: {error}") from None
        return self._observation

    def _attributes(self) -> dict[str, tuple[dict[str, Any], str]]:
        """Every attribute's dictionary and name, by key."""
        return {
            f"{depth}.{name}": (vars(layer), name)
            for depth, layer in enumerate(self._layers)
            for name in vars(layer)
            if name not in _RNG and not (name == "env" and isinstance(layer, gym.Wrapper))
        }

    def _encoded(self) -> dict[str, bytes]:
        left = frozenset(map(id, [*self._layers, self._own, getattr(self._env.unwrapped, "_np_random", None)]))
        found = {key: encode_state(held[name], leave=left) for key, (held, name) in self._attributes().items()}
        if self._own is not None:
            found[_OWN] = encode_state(self._own.get_state())
        if self._mujoco is not None:
            found[_MUJOCO] = self._mujoco.get()
        return found

    def _restore(self, wanted: dict[str, bytes]) -> None:
        if self._own is not None:
            call_user(f"environment {self._env}", "set_state()", self._own.set_state, decode_state(wanted[_OWN], None))
        attributes = self._attributes()
        for key in [key for key in attributes if key not in wanted]:
            held, name = attributes[key]
            del held[name]
        for key, code in wanted.items():
            if key not in (_OWN, _MUJOCO):
                depth, _, name = key.partition(".")
                held = vars(self._layers[int(depth)])
                held[name] = decode_state(code, held.get(name))
        if self._mujoco is not None:
            self._mujoco.set(wanted[_MUJOCO])

    def reseed(self, seed: int) -> None:
        """See ``Snapshots.reseed``."""
        reseed(self._env, seed)

    def bookkeeping(self) -> State:
        """Empty: the snapshot holds everything."""
        return {}

    def load_bookkeeping(self, state: State) -> None:
        """Nothing to load."""


class _MujocoState:
    """MuJoCo's integration state, with the solver's warm start."""

    def __init__(self, env: Any) -> None:
        import mujoco

        self._mujoco, self._env = mujoco, env
        self._kind = mujoco.mjtState.mjSTATE_INTEGRATION

    def get(self) -> bytes:
        state = np.empty(self._mujoco.mj_stateSize(self._env.model, self._kind))
        self._mujoco.mj_getState(self._env.model, self._env.data, state, self._kind)
        return state.tobytes()

    def set(self, data: bytes) -> None:
        """Restore, and derive position-dependent data (sites, sensors)."""
        state = np.frombuffer(data, np.float64).copy()
        self._mujoco.mj_setState(self._env.model, self._env.data, state, self._kind)
        self._mujoco.mj_forward(self._env.model, self._env.data)
        self._mujoco.mj_setState(self._env.model, self._env.data, state, self._kind)
