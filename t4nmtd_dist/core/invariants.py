"""Invariants of state machines, checked between events."""

from __future__ import annotations

from collections.abc import Mapping


class InvariantError(AssertionError):
    """A state machine in an invalid state: a bug in the program, whatever its input."""


def require(holds: bool, text: str, *values: object) -> None:
    """Raise if an invariant is violated.

    Raises:
        InvariantError: with the text, formatted with ``values``.
    """
    if not holds:
        raise InvariantError(text.format(*values))


class Monotone:
    """Checks that numbers never decrease between checks."""

    def __init__(self) -> None:
        self._seen: dict[str, float] = {}

    def check(self, numbers: Mapping[str, float]) -> None:
        """Compare numbers by name with the last check.

        Raises:
            InvariantError: if one decreased or is missing.
        """
        for name, before in self._seen.items():
            require(name in numbers, "{} was {:g} and is gone", name, before)
            require(numbers[name] >= before, "{} fell from {:g} to {:g}", name, before, numbers[name])
        self._seen = dict(numbers)
