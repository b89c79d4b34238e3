"""Registry of Python objects that a task uses instead of importable functions.

Functions from a notebook or the running script cannot be imported by name. ``Task`` registers them here and writes
``python:NAME`` into the settings. Forked processes inherit the registry; all others refuse such a task.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

GIVEN = "python:"
NUMBER = re.compile(r"-\d+$")

_objects: dict[str, Callable[..., Any]] = {}


def give(function: Callable[..., Any]) -> str:
    """Register ``function`` and return its setting.

    The same function keeps its name; a different one of that name gets a number.
    """
    plain = getattr(function, "__name__", type(function).__name__)
    number, name = 1, plain
    while _objects.get(name, function) is not function:
        number += 1
        name = f"{plain}-{number}"
    _objects[name] = function
    return GIVEN + name


def is_given(setting: str) -> bool:
    """Whether a setting refers to an object of the process that wrote it."""
    return setting.startswith(GIVEN)


def same_code(one: str, other: str) -> bool:
    """Whether two settings name the same code, or functions of one name."""
    return one == other or (is_given(one) and is_given(other) and _plain(one) == _plain(other))


def _plain(setting: str) -> str:
    return NUMBER.sub("", setting)


def given(setting: str) -> Callable[..., Any] | None:
    """The object of a setting; None if this process has none."""
    return _objects.get(setting.removeprefix(GIVEN))
