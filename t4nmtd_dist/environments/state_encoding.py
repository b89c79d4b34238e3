"""Encodes the state of Python objects as bytes without pickle.

Encodes numbers, strings, arrays, containers, random generators, enums and the attributes of ordinary objects.
Functions, modules, locks, surfaces, physics engines and the like are *opaque*: assumed constant, which
``environments.snapshot_choice`` verifies by stepping.

``environments.state_decoding`` restores existing objects in place.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from enum import Enum
from types import ModuleType
from typing import Any

import gymnasium as gym
import msgpack
import numpy as np

from t4nmtd_dist.core.errors import EnvError

MOST_NODES = 200_000

_PLAIN = (type(None), bool, float, str, bytes)
OPAQUE = (type, ModuleType, gym.Space, gym.envs.registration.EnvSpec)
_NUMERIC = "biufc"
OPAQUE_CODE = ["?"]
_INT64 = range(-(2**63), 2**63)


class CannotRestoreError(EnvError):
    """A state that cannot be encoded, or not restored into the existing objects."""


def encode_state(value: Any, *, leave: frozenset[int] = frozenset()) -> bytes:
    """Encode a value's state; equal states give equal bytes. Objects with ids in ``leave`` are opaque.

    Raises:
        CannotRestoreError: if it has too many parts.
    """
    encoded: bytes = msgpack.packb(_Encoder(leave).encode(value))
    return encoded


class _Encoder:
    def __init__(self, leave: frozenset[int]) -> None:
        self._seen = set(leave)
        self._nodes = 0

    def encode(self, value: Any) -> Any:
        self._nodes += 1
        if self._nodes > MOST_NODES:
            raise CannotRestoreError(f"the state has more than {MOST_NODES} parts")
        if type(value) in _PLAIN:
            return value
        if isinstance(value, np.ndarray | np.generic):
            return _encode_numbers(value)
        if isinstance(value, Enum):
            return ["e", value.name]
        if isinstance(value, _PLAIN):
            return value
        if isinstance(value, int):
            return value if value in _INT64 else ["i", str(value)]
        if id(value) in self._seen or isinstance(value, OPAQUE):
            return OPAQUE_CODE
        return self._encode_parts(value)

    def _encode_parts(self, value: Any) -> Any:
        """Encode containers at every occurrence, objects at the first."""
        self._seen.add(id(value))
        encode = _ENCODERS.get(type(value)) or _inherited_encoder(value)
        if encode is not None:
            code = encode(self, value)
            self._seen.discard(id(value))
            return code
        if hasattr(value, "__dict__") and not callable(value):
            return ["o", self._pairs(vars(value))]
        return OPAQUE_CODE

    def _tuple(self, value: tuple[Any, ...]) -> Any:
        return ["t", [self.encode(item) for item in value]]

    def _pairs(self, mapping: dict[Any, Any]) -> list[Any]:
        return [[self.encode(key), self.encode(item)] for key, item in mapping.items()]

    def _list(self, value: list[Any]) -> Any:
        return ["l", [self.encode(item) for item in value]]

    def _dict(self, value: dict[Any, Any]) -> Any:
        return ["d", self._pairs(value)]

    def _set(self, value: set[Any]) -> Any:
        return ["s", sorted((self.encode(item) for item in value), key=msgpack.packb)]

    def _frozenset(self, value: frozenset[Any]) -> Any:
        return ["f", self._set(set(value))[1]]

    def _deque(self, value: deque[Any]) -> Any:
        return ["q", [self.encode(item) for item in value]]

    def _generator(self, value: np.random.Generator) -> Any:
        return ["g", self.encode(dict(value.bit_generator.state))]

    def _random_state(self, value: np.random.RandomState) -> Any:
        return ["r", self.encode(value.get_state(legacy=False))]

    def _python_random(self, value: random.Random) -> Any:
        return ["p", self.encode(value.getstate())]


_ENCODERS: dict[type, Callable[[_Encoder, Any], Any]] = {
    tuple: _Encoder._tuple,
    list: _Encoder._list,
    dict: _Encoder._dict,
    set: _Encoder._set,
    frozenset: _Encoder._frozenset,
    deque: _Encoder._deque,
    np.random.Generator: _Encoder._generator,
    np.random.RandomState: _Encoder._random_state,
    random.Random: _Encoder._python_random,
}


def _inherited_encoder(value: Any) -> Callable[[_Encoder, Any], Any] | None:
    return next((encode for kind, encode in _ENCODERS.items() if isinstance(value, kind)), None)


def _encode_numbers(value: Any) -> Any:
    if value.dtype.kind not in _NUMERIC:
        return OPAQUE_CODE
    tag = "a" if isinstance(value, np.ndarray) else "n"
    return [tag, value.dtype.str, list(value.shape), value.tobytes()]
