"""Two patterns that generate the LTLf text of the built-in tasks."""

from __future__ import annotations

from collections.abc import Collection, Sequence


def strict_then(colours: Sequence[str], watched: Sequence[Collection[str]] | None = None) -> str:
    """The colours in the given order, with no watched colour in between.

    ``strict_then(["a", "b"])`` is ``(!a & !b) U (a & X((!a & !b) U b))``. The right colour counts even if a wrong one
    holds too.

    Args:
        colours: propositions to meet in order, at least one.
        watched: per stage, propositions forbidden before its colour; by default all colours.

    Raises:
        ValueError: if there is no colour, or not one collection of watched propositions per colour.
    """
    if watched is None:
        watched = [colours] * len(colours)
    if not colours or len(watched) != len(colours):
        raise ValueError(
            "expected at least one colour and one collection of watched propositions for each, "
            f"got {len(colours)} and {len(watched)}"
        )
    text = ""
    for colour, wrong in zip(reversed(colours), reversed(watched), strict=True):
        goal = f"({colour} & X({text}))" if text else colour
        waiting = " & ".join(f"!{name}" for name in wrong) or "true"
        text = f"({waiting}) U {goal}"
    return text


def then(goals: Sequence[str]) -> str:
    """The goals in the given order, each at a later step than the one before.

    ``then(["a", "b"])`` is ``F(a & X(F(b)))``.

    Raises:
        ValueError: if there is no goal.
    """
    if not goals:
        raise ValueError("expected at least one goal, got none")
    text = f"F({goals[-1]})"
    for goal in reversed(goals[:-1]):
        text = f"F({goal} & X({text}))"
    return text
