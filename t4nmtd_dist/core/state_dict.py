"""Checkpoint states: trees of arrays, numbers, strings and lists, split for files and rejoined.

Stateful objects implement ``state_dict()`` and ``load_state_dict()``; composites return a dict. A numpy generator is
stored as ``rng.bit_generator.state``.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

State = dict[str, Any]
Arrays = dict[str, NDArray[Any]]

_ARRAY = "array:"


def split(state: Mapping[str, Any]) -> tuple[State, Arrays]:
    """Split a tree into JSON data, with names in place of arrays, and the arrays by name.

    Raises:
        TypeError: if a key is not a string, or a value is neither an array nor JSON data.
    """
    arrays: Arrays = {}
    plain: State = _split(state, "", arrays)
    return plain, arrays


def _split(value: Any, path: str, arrays: Arrays) -> Any:
    if isinstance(value, np.ndarray):
        arrays[path] = value
        return _ARRAY + path
    if isinstance(value, Mapping):
        return {_key(key): _split(inner, f"{path}/{key}", arrays) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_split(inner, f"{path}/{i}", arrays) for i, inner in enumerate(value)]
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, str):
        return ":" + value  # distinguishes strings from array names
    if value is None or isinstance(value, bool | int | float):
        return value
    raise TypeError(f"state{path}: {type(value).__name__} cannot be written to a checkpoint")


def _key(key: object) -> str:
    if not isinstance(key, str):
        raise TypeError(f"a state has the key {key!r}; expected a text")
    return key


def joined(plain: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    """Rejoin the result of ``split``; tuples have become lists.

    Raises:
        KeyError: if an array is missing.
    """
    if isinstance(plain, Mapping):
        return {key: joined(inner, arrays) for key, inner in plain.items()}
    if isinstance(plain, list):
        return [joined(inner, arrays) for inner in plain]
    if isinstance(plain, str):
        return plain[1:] if plain.startswith(":") else arrays[plain.removeprefix(_ARRAY)]
    return plain


def copied(state: Mapping[str, Any]) -> State:
    """The tree with copies of all arrays."""
    plain, arrays = split(state)
    copy: State = joined(plain, {name: array.copy() for name, array in arrays.items()})
    return copy


def plain_text(plain: State) -> str:
    """JSON text; numbers keep all digits."""
    return json.dumps(plain)


def stacked(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Stack equal-shaped arrays as [n, ...]; float64 [0, 0] for none."""
    return np.stack(arrays) if arrays else np.zeros((0, 0))


def generator_states(generators: Iterable[np.random.Generator | None]) -> list[Any]:
    """States for ``set_generator_states``; None for missing generators."""
    return [None if each is None else each.bit_generator.state for each in generators]


def set_generator_states(generators: Iterable[np.random.Generator | None], states: Sequence[Any]) -> None:
    """Restore the states of generators."""
    for generator, state in zip(generators, states, strict=True):
        if generator is not None and state is not None:
            generator.bit_generator.state = state
