"""States to be checkpointed: trees of arrays, numbers, texts and lists, split for files and put together again.

Stateful objects implement ``state_dict()`` and ``load_state_dict()``; composites return a dict. Generators of numpy
fit in as ``rng.bit_generator.state``.
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
    """A tree as JSON data in which names stand for the arrays, and the arrays by those names.

    Raises:
        TypeError: if a key is no text, or a value is neither an array nor JSON data.
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
        return ":" + value  # so that no text is taken for the name of an array
    if value is None or isinstance(value, bool | int | float):
        return value
    raise TypeError(f"state{path}: {type(value).__name__} cannot be written to a checkpoint")


def _key(key: object) -> str:
    if not isinstance(key, str):
        raise TypeError(f"a state has the key {key!r}; expected a text")
    return key


def joined(plain: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    """The tree that ``split`` was given; tuples have become lists.

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
    """The tree with copies of all arrays, which later changes leave alone."""
    plain, arrays = split(state)
    copy: State = joined(plain, {name: array.copy() for name, array in arrays.items()})
    return copy


def plain_text(plain: State) -> str:
    """JSON; numbers keep all their digits."""
    return json.dumps(plain)


def stacked(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Arrays that are alike as one [n, ...]; float64 [0, 0] for none."""
    return np.stack(arrays) if arrays else np.zeros((0, 0))


def generator_states(generators: Iterable[np.random.Generator | None]) -> list[Any]:
    """What ``set_generator_states`` needs; None for a generator that is missing."""
    return [None if each is None else each.bit_generator.state for each in generators]


def set_generator_states(generators: Iterable[np.random.Generator | None], states: Sequence[Any]) -> None:
    """Let generators go on from where others of their kind were."""
    for generator, state in zip(generators, states, strict=True):
        if generator is not None and state is not None:
            generator.bit_generator.state = state
