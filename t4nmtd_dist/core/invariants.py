"""Invariants of state machines: what must hold between any two events."""

from __future__ import annotations

from collections.abc import Mapping


class InvariantError(AssertionError):
    """A state machine has come into a state that must not be: a defect of the program, whatever was sent to it."""


def require(holds: bool, text: str, *values: object) -> None:
    """Raise if an invariant does not hold.

    Raises:
        InvariantError: with the text, in which ``values`` stand for its ``{}``.
    """
    if not holds:
        raise InvariantError(text.format(*values))


class Monotone:
    """Numbers that may never decrease, remembered from one check to the next."""

    def __init__(self) -> None:
        self._seen: dict[str, float] = {}

    def check(self, numbers: Mapping[str, float]) -> None:
        """Compare numbers by name with those of the last check.

        Raises:
            InvariantError: if one is smaller, or missing.
        """
        for name, before in self._seen.items():
            require(name in numbers, "{} was {:g} and is gone", name, before)
            require(numbers[name] >= before, "{} fell from {:g} to {:g}", name, before, numbers[name])
        self._seen = dict(numbers)
