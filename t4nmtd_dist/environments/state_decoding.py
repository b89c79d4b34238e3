"""Restores encoded state (``environments.state_encoding``) into Python objects.

Decoding modifies existing objects in place, so that all references to them see the change.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable, MutableMapping
from enum import Enum
from typing import Any

import msgpack
import numpy as np

from t4nmtd_dist.environments.state_encoding import OPAQUE, OPAQUE_CODE, CannotRestoreError


def decode_state(encoded: bytes, current: Any) -> Any:
    """The value encoded by ``encode_state``, stored in ``current`` if possible, else new.

    Raises:
        CannotRestoreError: if ``current`` lacks required objects.
    """
    return _decode(msgpack.unpackb(encoded, strict_map_key=False), current)


def _decode(code: Any, current: Any) -> Any:
    if not isinstance(code, list):
        return code
    return _DECODERS[code[0]](code, current)


def _decode_array(code: list[Any], current: Any) -> Any:
    _, dtype, shape, data = code
    array = np.frombuffer(data, dtype).reshape(shape)
    if isinstance(current, np.ndarray) and current.dtype == array.dtype and current.shape == array.shape:
        if current.flags.writeable:
            current[...] = array
            return current
        if current.tobytes() == data:
            return current
    return array.copy()


def _decode_number(code: list[Any], _: Any) -> Any:
    return np.frombuffer(code[3], code[1])[0]


def _decode_items(codes: list[Any], current: Any, kind: type[Any]) -> list[Any]:
    held: list[Any] = [*current] if isinstance(current, kind) else []
    held += [None] * (len(codes) - len(held))
    return [_decode(code, item) for code, item in zip(codes, held, strict=False)]


def _decode_tuple(code: list[Any], current: Any) -> Any:
    items = _decode_items(code[1], current, tuple)
    named = getattr(current, "_make", None) if isinstance(current, tuple) else None
    return named(items) if named is not None else tuple(items)


def _decode_list(code: list[Any], current: Any) -> Any:
    items = _decode_items(code[1], current, list)
    if not isinstance(current, list):
        return items
    current[:] = items
    return current


def _decode_deque(code: list[Any], current: Any) -> Any:
    if not isinstance(current, deque):
        raise CannotRestoreError(f"a deque is to be restored where there is {type(current).__name__} now")
    items = _decode_items(code[1], current, deque)
    current.clear()
    current.extend(items)
    return current


def _decode_dict(code: list[Any], current: Any) -> Any:
    held = current if isinstance(current, dict) else {}
    fresh = {key: _decode(item, held.get(key)) for key, item in _decode_pairs(code)}
    held.clear()
    held.update(fresh)
    return held


def _decode_pairs(code: list[Any]) -> list[tuple[Any, Any]]:
    return [(_decode(key, None), item) for key, item in code[1]]


def _decode_set(code: list[Any], current: Any) -> Any:
    items = {_decode(item, None) for item in code[1]}
    if not isinstance(current, set):
        return items
    current.clear()
    current.update(items)
    return current


def _decode_frozenset(code: list[Any], _: Any) -> Any:
    return frozenset(_decode(item, None) for item in code[1])


def _decode_object(code: list[Any], current: Any) -> Any:
    if not hasattr(current, "__dict__") or isinstance(current, OPAQUE):
        raise CannotRestoreError(f"an object is to be restored where there is {type(current).__name__} now")
    _restore_attributes(vars(current), dict(_decode_pairs(code)))
    return current


def _restore_attributes(held: MutableMapping[str, Any], codes: dict[str, Any]) -> None:
    """Give ``held`` exactly the attributes of ``codes``."""
    for name in [name for name in held if name not in codes]:
        del held[name]
    for name, code in codes.items():
        if code != OPAQUE_CODE:
            held[name] = _decode(code, held.get(name))


def _decode_generator(code: list[Any], current: Any) -> Any:
    if not isinstance(current, np.random.Generator):
        raise CannotRestoreError(f"a random generator is to be restored where there is {type(current).__name__} now")
    current.bit_generator.state = _decode(code[1], None)
    return current


def _decode_random_state(code: list[Any], current: Any) -> Any:
    if not isinstance(current, np.random.RandomState):
        raise CannotRestoreError(f"a random generator is to be restored where there is {type(current).__name__} now")
    current.set_state(_decode(code[1], None))
    return current


def _decode_python_random(code: list[Any], current: Any) -> Any:
    if not isinstance(current, random.Random):
        raise CannotRestoreError(f"a random generator is to be restored where there is {type(current).__name__} now")
    current.setstate(_decode(code[1], None))
    return current


def _decode_enum(code: list[Any], current: Any) -> Any:
    if not isinstance(current, Enum):
        raise CannotRestoreError(f"{code[1]!r} of an enumeration is to be restored where there is {current!r} now")
    return type(current)[code[1]]


_DECODERS: dict[str, Callable[[list[Any], Any], Any]] = {
    "?": lambda _, current: current,
    "i": lambda code, _: int(code[1]),
    "e": _decode_enum,
    "a": _decode_array,
    "n": _decode_number,
    "t": _decode_tuple,
    "l": _decode_list,
    "d": _decode_dict,
    "s": _decode_set,
    "f": _decode_frozenset,
    "q": _decode_deque,
    "o": _decode_object,
    "g": _decode_generator,
    "r": _decode_random_state,
    "p": _decode_python_random,
}
