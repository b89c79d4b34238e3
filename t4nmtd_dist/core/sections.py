"""Reads, checks and serialises a section of settings, a frozen dataclass."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from functools import cache
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import msgspec

from t4nmtd_dist.core.errors import ConfigError

Section = TypeVar("Section")

_PLACE = re.compile(r"(?P<text>.*?)(?: - at `\$\.?(?P<path>[^`]*)`)?", re.DOTALL)
_MISSING = re.compile(r"Object missing required field `(?P<field>.*)`")


def read_section(kind: type[Section], data: Any, key: str = "") -> Section:
    """Read a section from a mapping; ignores unknown keys. ``key`` is its name, for messages.

    Raises:
        ConfigError: on a missing key, a wrong type, or a value out of range; names the key, the expectation and the
            value.
    """
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        raise ConfigError(_sentence(str(error), kind, data, key)) from None


def check_ranges(section: Any, key: str = "") -> None:
    """Check the values of a section constructed in code, and of its subsections.

    Raises:
        ConfigError: if one is out of range.
    """
    for name, hint in hints(type(section)).items():
        value, dotted = getattr(section, name), _dotted(key, name)
        if dataclasses.is_dataclass(value):
            check_ranges(value, dotted)
        elif (expected := _description(hint)) and not _fits(value, hint):
            raise ConfigError(f"{dotted} = {_shown(value)}: expected {expected}")


def plain(value: Any) -> Any:
    """A setting as builtins, defaults included, which msgspec would omit."""
    if dataclasses.is_dataclass(value):
        return {each.name: plain(getattr(value, each.name)) for each in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {name: plain(each) for name, each in value.items()}
    return msgspec.to_builtins(value)


def hints(kind: Any) -> Mapping[str, Any]:
    """Types of a section's fields, with their ranges."""
    return _hints(kind)


@cache
def _hints(kind: Any) -> Mapping[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _fits(value: Any, hint: Any) -> bool:
    try:
        msgspec.convert(value, hint)
    except msgspec.ValidationError:
        return False
    return True


def _description(hint: Any) -> str:
    """A setting type's description of its range, if any."""
    found = (each.description for each in getattr(hint, "__metadata__", ()) if isinstance(each, msgspec.Meta))
    return next(found, None) or ""


def _sentence(error: str, kind: type, data: Any, key: str) -> str:
    """A msgspec validation error in terms of keys."""
    match = _PLACE.fullmatch(error)
    text, path = (match["text"], match["path"] or "") if match else (error, "")
    names = [name for name in re.sub(r"\[.*", "", path).split(".") if name]
    dotted = _dotted(key, *names)
    if missing := _MISSING.fullmatch(text):
        return f"missing key {_dotted(dotted, missing['field'])!r}"
    came = _shown(_at(data, names))
    return f"{dotted} = {came}: expected {_expected(text, _hint(kind, names))}"


def _expected(text: str, hint: Any) -> str:
    if text.startswith("Invalid enum value") and get_origin(hint) is Literal:
        return f"one of {', '.join(map(repr, get_args(hint)))}"
    if ", got " not in text and (described := _description(hint)):
        return described
    return text.removeprefix("Expected ")


def _hint(kind: Any, names: list[str]) -> Any:
    for name in names:
        kind = hints(kind).get(name) if dataclasses.is_dataclass(kind) else None
    return kind


def _at(data: Any, names: list[str]) -> Any:
    for name in names:
        data = data.get(name) if isinstance(data, Mapping) else None
    return data


def _dotted(*names: str) -> str:
    return ".".join(name for name in names if name)


def _shown(value: Any) -> str:
    return repr(list(value) if isinstance(value, tuple) else value)
