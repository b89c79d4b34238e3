"""Shared parts of byte snapshots: padding to one length, and the environment's ``np_random``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.environments.opening import Env

_LENGTH = np.dtype("<u4")


def reseed(env: Env, seed: int) -> None:
    """Seed the environment's ``np_random`` in place, so that all references to it see the change."""
    fresh = np.random.default_rng(seed)
    held = env.unwrapped.np_random
    if type(held.bit_generator) is type(fresh.bit_generator):
        held.bit_generator.state = fresh.bit_generator.state
    else:
        env.unwrapped.np_random = fresh


def rng_state(env: Env) -> Any:
    """State of the environment's ``np_random``; None if it does not exist yet."""
    held = getattr(env.unwrapped, "_np_random", None)
    return held.bit_generator.state if isinstance(held, np.random.Generator) else None


def set_rng_state(env: Env, state: Any) -> None:
    """Restore the environment's ``np_random`` from ``rng_state``."""
    if state is not None:
        env.unwrapped.np_random.bit_generator.state = state


def padded(data: bytes, size: int) -> NDArray[np.uint8]:
    """Length, data, and zero padding up to ``size`` bytes of data (0: none), uint8.

    Raises:
        EnvError: if the data is longer.
    """
    if size and len(data) > size:
        raise EnvError(
            f"a snapshot takes {len(data)} bytes, and the task has room for {size}: "
            'set environment.snapshot_bytes higher, or environment.snapshots = "replay"'
        )
    array = np.zeros(_LENGTH.itemsize + max(size, len(data)), np.uint8)
    array[:4].view(_LENGTH)[0] = len(data)
    array[4 : 4 + len(data)] = np.frombuffer(data, np.uint8)
    return array


def unpadded(state: NDArray[Any]) -> bytes:
    """The data passed to ``padded``.

    Raises:
        ValueError: if ``padded`` did not make the array.
    """
    if state.dtype != np.uint8 or state.ndim != 1 or len(state) < _LENGTH.itemsize:
        raise ValueError(f"expected uint8 [n], got {state.dtype} {state.shape}")
    length = int(np.ascontiguousarray(state[:4]).view(_LENGTH)[0])
    if length > len(state) - 4:
        raise ValueError(f"{length} bytes announced, {len(state) - 4} came")
    return state[4 : 4 + length].tobytes()
