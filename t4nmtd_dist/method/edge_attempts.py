"""What the upper levels of LSTS and DIRL share: attempts at an edge, paths, and training in equal shares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from t4nmtd_dist.automata.reduction import Transition


class Attempt(NamedTuple):
    """An attempt at an edge that has ended.

    Attributes:
        success: it reached the edge's target.
        steps: its length in interactions.
    """

    success: bool
    steps: int


class EvenShares:
    """Edges that train on by turns, so that each gets as many interactions as the others.

    Args:
        edges: in the order in which they take turns.
        spent: interactions of each so far.
    """

    def __init__(self, edges: Sequence[str], spent: Mapping[str, int] | None = None) -> None:
        self.spent = dict.fromkeys(edges, 0) if spent is None else dict(spent)

    def spend(self, edge: str, attempts: Sequence[Attempt]) -> None:
        """Count the attempts of an edge, if it is one of these."""
        if edge in self.spent:
            self.spent[edge] += sum(attempt.steps for attempt in attempts)

    def next(self) -> str:
        """The edge that has had least; the first by name of several."""
        return min(self.spent, key=lambda edge: (self.spent[edge], edge))


def on_path(edges: Mapping[str, Transition], incoming: Mapping[int, str], target: int) -> tuple[str, ...]:
    """The edges that lead to a vertex, the first one first.

    Args:
        edges: transitions by name.
        incoming: the edge by which each vertex was reached; none for the one where paths begin.
        target: the last vertex.
    """
    path: list[str] = []
    while target in incoming:
        path.append(incoming[target])
        target = edges[path[-1]][0]
    return tuple(reversed(path))
