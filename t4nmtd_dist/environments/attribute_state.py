"""The state of Python objects as bytes, and back, without pickle: what is not plain data is left alone.

Numbers, texts, arrays, containers, random generators, enumerations and the attributes of ordinary objects are
written down. Functions, modules, locks, surfaces, physics engines and the like are *opaque*: they are taken for
constants. Whether that is true is checked elsewhere, by stepping (``environments.restoring``).

Restoring writes into the objects that are there, so that whoever else refers to them sees the change.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable, MutableMapping
from enum import Enum
from types import ModuleType
from typing import Any

import gymnasium as gym
import msgpack
import numpy as np

from t4nmtd_dist.core.errors import EnvError

MOST_NODES = 200_000

_PLAIN = (type(None), bool, float, str, bytes)
_OPAQUE = (type, ModuleType, gym.Space, gym.envs.registration.EnvSpec)
_NUMERIC = "biufc"
_OPAQUE_CODE = ["?"]
_INT64 = range(-(2**63), 2**63)


class CannotRestoreError(EnvError):
    """A state that cannot be written down, or cannot be put back into the objects that are there."""


def pack(value: Any, *, leave: frozenset[int] = frozenset()) -> bytes:
    """The state of a value as bytes; equal states give equal bytes.

    Args:
        value: any object.
        leave: ids of objects to treat as opaque.

    Raises:
        CannotRestoreError: if it is too big to be walked through.
    """
    packed: bytes = msgpack.packb(_Writer(leave).write(value))
    return packed


def restored(packed: bytes, current: Any) -> Any:
    """What ``pack`` wrote down, put into ``current`` as far as it can hold it, else new.

    Raises:
        CannotRestoreError: if objects are needed that ``current`` does not have.
    """
    return _read(msgpack.unpackb(packed, strict_map_key=False), current)


class _Writer:
    def __init__(self, leave: frozenset[int]) -> None:
        self._seen = set(leave)
        self._nodes = 0

    def write(self, value: Any) -> Any:
        self._nodes += 1
        if self._nodes > MOST_NODES:
            raise CannotRestoreError(f"the state has more than {MOST_NODES} parts")
        if type(value) in _PLAIN:
            return value
        if isinstance(value, np.ndarray | np.generic):
            return _write_numbers(value)
        if isinstance(value, Enum):
            return ["e", value.name]
        if isinstance(value, _PLAIN):
            return value
        if isinstance(value, int):
            return value if value in _INT64 else ["i", str(value)]
        if id(value) in self._seen or isinstance(value, _OPAQUE):
            return _OPAQUE_CODE
        return self._write_parts(value)

    def _write_parts(self, value: Any) -> Any:
        """Containers: wherever they are met, but not inside themselves. Objects: where they are met first."""
        self._seen.add(id(value))
        write = _WRITERS.get(type(value)) or _inherited_writer(value)
        if write is not None:
            code = write(self, value)
            self._seen.discard(id(value))
            return code
        if hasattr(value, "__dict__") and not callable(value):
            return ["o", self._pairs(vars(value))]
        return _OPAQUE_CODE

    def _tuple(self, value: tuple[Any, ...]) -> Any:
        return ["t", [self.write(item) for item in value]]

    def _pairs(self, mapping: dict[Any, Any]) -> list[Any]:
        return [[self.write(key), self.write(item)] for key, item in mapping.items()]

    def _list(self, value: list[Any]) -> Any:
        return ["l", [self.write(item) for item in value]]

    def _dict(self, value: dict[Any, Any]) -> Any:
        return ["d", self._pairs(value)]

    def _set(self, value: set[Any]) -> Any:
        return ["s", sorted((self.write(item) for item in value), key=msgpack.packb)]

    def _frozenset(self, value: frozenset[Any]) -> Any:
        return ["f", self._set(set(value))[1]]

    def _deque(self, value: deque[Any]) -> Any:
        return ["q", [self.write(item) for item in value]]

    def _generator(self, value: np.random.Generator) -> Any:
        return ["g", self.write(dict(value.bit_generator.state))]

    def _random_state(self, value: np.random.RandomState) -> Any:
        return ["r", self.write(value.get_state(legacy=False))]

    def _python_random(self, value: random.Random) -> Any:
        return ["p", self.write(value.getstate())]


_WRITERS: dict[type, Callable[[_Writer, Any], Any]] = {
    tuple: _Writer._tuple,
    list: _Writer._list,
    dict: _Writer._dict,
    set: _Writer._set,
    frozenset: _Writer._frozenset,
    deque: _Writer._deque,
    np.random.Generator: _Writer._generator,
    np.random.RandomState: _Writer._random_state,
    random.Random: _Writer._python_random,
}


def _inherited_writer(value: Any) -> Callable[[_Writer, Any], Any] | None:
    return next((write for kind, write in _WRITERS.items() if isinstance(value, kind)), None)


def _write_numbers(value: Any) -> Any:
    if value.dtype.kind not in _NUMERIC:
        return _OPAQUE_CODE
    tag = "a" if isinstance(value, np.ndarray) else "n"
    return [tag, value.dtype.str, list(value.shape), value.tobytes()]


def _read(code: Any, current: Any) -> Any:
    if not isinstance(code, list):
        return code
    return _READERS[code[0]](code, current)


def _read_array(code: list[Any], current: Any) -> Any:
    _, dtype, shape, data = code
    array = np.frombuffer(data, dtype).reshape(shape)
    if isinstance(current, np.ndarray) and current.dtype == array.dtype and current.shape == array.shape:
        if current.flags.writeable:
            current[...] = array
            return current
        if current.tobytes() == data:
            return current
    return array.copy()


def _read_number(code: list[Any], _: Any) -> Any:
    return np.frombuffer(code[3], code[1])[0]


def _read_items(codes: list[Any], current: Any, kind: type[Any]) -> list[Any]:
    held: list[Any] = [*current] if isinstance(current, kind) else []
    held += [None] * (len(codes) - len(held))
    return [_read(code, item) for code, item in zip(codes, held, strict=False)]


def _read_tuple(code: list[Any], current: Any) -> Any:
    items = _read_items(code[1], current, tuple)
    named = getattr(current, "_make", None) if isinstance(current, tuple) else None
    return named(items) if named is not None else tuple(items)


def _read_list(code: list[Any], current: Any) -> Any:
    items = _read_items(code[1], current, list)
    if not isinstance(current, list):
        return items
    current[:] = items
    return current


def _read_deque(code: list[Any], current: Any) -> Any:
    if not isinstance(current, deque):
        raise CannotRestoreError(f"a deque is to be restored where there is {type(current).__name__} now")
    items = _read_items(code[1], current, deque)
    current.clear()
    current.extend(items)
    return current


def _read_dict(code: list[Any], current: Any) -> Any:
    held = current if isinstance(current, dict) else {}
    fresh = {key: _read(item, held.get(key)) for key, item in _read_pairs(code)}
    held.clear()
    held.update(fresh)
    return held


def _read_pairs(code: list[Any]) -> list[tuple[Any, Any]]:
    return [(_read(key, None), item) for key, item in code[1]]


def _read_set(code: list[Any], current: Any) -> Any:
    items = {_read(item, None) for item in code[1]}
    if not isinstance(current, set):
        return items
    current.clear()
    current.update(items)
    return current


def _read_frozenset(code: list[Any], _: Any) -> Any:
    return frozenset(_read(item, None) for item in code[1])


def _read_object(code: list[Any], current: Any) -> Any:
    if not hasattr(current, "__dict__") or isinstance(current, _OPAQUE):
        raise CannotRestoreError(f"an object is to be restored where there is {type(current).__name__} now")
    restore_attributes(vars(current), dict(_read_pairs(code)))
    return current


def restore_attributes(held: MutableMapping[str, Any], codes: dict[str, Any]) -> None:
    """Make ``held`` have exactly the attributes of ``codes``."""
    for name in [name for name in held if name not in codes]:
        del held[name]
    for name, code in codes.items():
        if code != _OPAQUE_CODE:
            held[name] = _read(code, held.get(name))


def _read_generator(code: list[Any], current: Any) -> Any:
    if not isinstance(current, np.random.Generator):
        raise CannotRestoreError(f"a random generator is to be restored where there is {type(current).__name__} now")
    current.bit_generator.state = _read(code[1], None)
    return current


def _read_random_state(code: list[Any], current: Any) -> Any:
    if not isinstance(current, np.random.RandomState):
        raise CannotRestoreError(f"a random generator is to be restored where there is {type(current).__name__} now")
    current.set_state(_read(code[1], None))
    return current


def _read_python_random(code: list[Any], current: Any) -> Any:
    if not isinstance(current, random.Random):
        raise CannotRestoreError(f"a random generator is to be restored where there is {type(current).__name__} now")
    current.setstate(_read(code[1], None))
    return current


def _read_enum(code: list[Any], current: Any) -> Any:
    if not isinstance(current, Enum):
        raise CannotRestoreError(f"{code[1]!r} of an enumeration is to be restored where there is {current!r} now")
    return type(current)[code[1]]


_READERS: dict[str, Callable[[list[Any], Any], Any]] = {
    "?": lambda _, current: current,
    "i": lambda code, _: int(code[1]),
    "e": _read_enum,
    "a": _read_array,
    "n": _read_number,
    "t": _read_tuple,
    "l": _read_list,
    "d": _read_dict,
    "s": _read_set,
    "f": _read_frozenset,
    "q": _read_deque,
    "o": _read_object,
    "g": _read_generator,
    "r": _read_random_state,
    "p": _read_python_random,
}
