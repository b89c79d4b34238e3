"""Graph layout of an automaton: states in columns, edges as bowed curves.

A state's column is the longest path to its strongly connected component. Within a column, the order keeps neighbours
level. Every edge takes the smallest bow that avoids states and drawn edges. Lengths are pixels, y points down.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.reduction import Transition, closure, predecessors

RADIUS = 21.0
COLUMN = 215.0
ROW = 136.0
BOWS = (0.0, 26.0, -26.0, 52.0, -52.0, 84.0, -84.0, 124.0, -124.0, 170.0, -170.0)
LABEL_AT = (0.5, 0.42, 0.58, 0.34, 0.66, 0.27, 0.73, 0.2, 0.8)

DIRECTIONS = (270, 90, 225, 315, 135, 45, 180, 0)

Points = NDArray[np.float64]


@dataclass(frozen=True)
class Curve:
    """A quadratic Bezier curve between the rims of two states; points of shape (2,)."""

    start: Points
    control: Points
    end: Points

    def at(self, t: float | Points) -> Points:
        """Points at parameters t in 0..1: shape (2,), or (n, 2) for n parameters."""
        t = np.asarray(t, dtype=np.float64)[..., None]
        point: Points = (1 - t) ** 2 * self.start + 2 * t * (1 - t) * self.control + t**2 * self.end
        return point


@dataclass(frozen=True)
class Box:
    """An axis-parallel box by centre, half width and half height."""

    x: float
    y: float
    half_width: float
    half_height: float

    def overlap(self, other: Box) -> float:
        """Area of the intersection."""
        across = self.half_width + other.half_width - abs(self.x - other.x)
        down = self.half_height + other.half_height - abs(self.y - other.y)
        return max(0.0, across) * max(0.0, down)

    def holds(self, points: Points) -> int:
        """Number of points, shape (n, 2), inside."""
        inside = np.abs(points - (self.x, self.y)) <= (self.half_width, self.half_height)
        return int(inside.all(axis=1).sum())


def place(initial: int, transitions: Collection[Transition], states: Iterable[int]) -> dict[int, Points]:
    """A position of shape (2,) for every state; the drawing's upper left corner is near (0, 0).

    Args:
        initial: the leftmost state.
        transitions: determine the columns; without self-loops.
        states: to place; unreached ones go in the last column.
    """
    column = _columns(initial, transitions, states)
    rows = _rows(column, transitions)
    tallest = max(len(row) for row in rows)
    return {
        q: np.array([x * COLUMN, (i + (tallest - len(row)) / 2) * ROW])
        for x, row in enumerate(rows)
        for i, q in enumerate(row)
    }


def route(transitions: Iterable[Transition], position: Mapping[int, Points]) -> dict[Transition, Curve]:
    """A curve for every transition, with as few collisions as the available bows allow."""
    edges = sorted(transitions, key=lambda tau: float(np.hypot(*(position[tau[1]] - position[tau[0]]))))
    pairs = set(edges)
    curves: dict[Transition, Curve] = {}
    drawn = np.empty((0, 2))
    for q, target in edges:
        others = np.array([p for s, p in position.items() if s not in (q, target)]).reshape(-1, 2)
        bows = BOWS[1:] if (target, q) in pairs else BOWS
        options = [_curve(position[q], position[target], bow) for bow in bows]
        costs = [abs(bow) * 0.35 + _crowding(curve, others, drawn) for bow, curve in zip(bows, options, strict=True)]
        curves[q, target] = options[int(np.argmin(costs))]
        drawn = np.concatenate([drawn, curves[q, target].at(np.linspace(0.15, 0.85, 15))])
    return curves


def free_directions(at: Points, curves: Iterable[Curve], prefer: tuple[int, ...] = DIRECTIONS) -> list[Points]:
    """Unit vectors out of a state, the least crowded by curves first.

    ``prefer`` gives directions in degrees, clockwise from the right; the earlier wins a tie.
    """
    points = np.concatenate([np.empty((0, 2)), *(curve.at(np.linspace(0, 1, 40)) for curve in curves)])
    angles = np.radians(prefer)
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)

    def crowding(direction: Points) -> int:
        return int((np.hypot(*(points - at - 42 * direction).T) < 26).sum())

    return sorted(directions, key=crowding)


def label_boxes(
    curves: Mapping[Transition, Curve], widths: Mapping[Transition, float], taken: Iterable[Box]
) -> dict[Transition, Box]:
    """A label box of given width on every curve, away from ``taken``, states, labels and other curves."""
    boxes = list(taken)
    found: dict[Transition, Box] = {}
    samples = {tau: curve.at(np.linspace(0, 1, 40)) for tau, curve in curves.items()}
    for tau, curve in curves.items():
        rest = np.concatenate([np.empty((0, 2)), *(points for other, points in samples.items() if other != tau)])
        middles = curve.at(np.array(LABEL_AT)).tolist()
        options = [Box(x, y, widths[tau] / 2, 8.0) for x, y in middles]
        costs = [
            abs(t - 0.5) * 40 + 3 * sum(box.overlap(b) for b in boxes) + 12 * box.holds(rest)
            for t, box in zip(LABEL_AT, options, strict=True)
        ]
        found[tau] = options[int(np.argmin(costs))]
        boxes.append(found[tau])
    return found


def _columns(initial: int, transitions: Collection[Transition], states: Iterable[int]) -> dict[int, int]:
    """Column of every state: the longest path to its component."""
    successors = predecessors((target, q) for q, target in transitions)
    ahead = {q: closure([q], successors) for q in {initial, *(q for tau in transitions for q in tau)}}
    column: dict[int, int] = {}
    # Sorting by the number of reachable states gives a topological order of the components.
    for q in sorted(ahead[initial], key=lambda q: -len(ahead[q])):
        component = {p for p in ahead[q] if q in ahead[p]}
        if q not in column:
            before = [
                column[p] for p, target in transitions if target in component and p not in component and p in column
            ]
            column.update(dict.fromkeys(component, max(before, default=-1) + 1))
    last = max(column.values()) + 1
    return {q: column.get(q, last) for q in states}


def _rows(column: Mapping[int, int], transitions: Collection[Transition]) -> list[list[int]]:
    """States of every column, ordered by the mean height of their neighbours."""
    rows = [sorted(q for q in column if column[q] == x) for x in range(max(column.values()) + 1)]
    for sweep in range(6):
        order = range(len(rows)) if sweep % 2 == 0 else range(len(rows) - 1, -1, -1)
        for x in order:
            height = {q: i - (len(row) - 1) / 2 for row in rows for i, q in enumerate(row)}
            near = {
                q: [
                    height[a if b == q else b] for a, b in transitions if q in (a, b) and column.get(a) != column.get(b)
                ]
                for q in rows[x]
            }
            rows[x].sort(key=lambda q: (float(np.mean(near[q])) if near[q] else height[q], q))
    return rows


def _curve(a: Points, b: Points, bow: float) -> Curve:
    """A curve whose middle is ``bow`` pixels left of the straight line."""
    along = b - a
    normal = np.array([along[1], -along[0]]) / np.hypot(*along)
    control = (a + b) / 2 + 2 * bow * normal
    return Curve(_rim(a, control), control, _rim(b, control, gap=4.0))


def _rim(centre: Points, toward: Points, gap: float = 0.0) -> Points:
    direction = toward - centre
    rim: Points = centre + direction / np.hypot(*direction) * (RADIUS + gap)
    return rim


def _crowding(curve: Curve, states: Points, drawn: Points) -> float:
    """Penalty for touching states (heavy) and running along curves (light)."""
    points = curve.at(np.linspace(0.05, 0.95, 25))[:, None, :]
    to_states = np.hypot(*np.moveaxis(points - states, -1, 0))
    to_curves = np.hypot(*np.moveaxis(points - drawn, -1, 0))
    return float(np.maximum(0, RADIUS + 16 - to_states).sum() * 4 + np.maximum(0, 9 - to_curves).sum() * 1.5)
