"""Racecar's track: targets, and walls as static segments of a pymunk space."""

from __future__ import annotations

import math

import pymunk

Point = tuple[float, float]

OUTER = 1.5  # half a side of the outer square
OBSTACLE_RADIUS = 0.3
OBSTACLE_SIDES = 36
START: Point = (0.0, -0.7)
TARGETS: tuple[Point, ...] = ((0.75, -0.75), (-0.75, -0.75), (0.75, 0.75), (-0.75, 0.75))  # g1 to g4
TARGET_RADIUS = 0.25
DISTANCE_BOUND = 3.2  # the farthest corner is 3.182 from a target

SQUARE: tuple[Point, ...] = ((OUTER, OUTER), (-OUTER, OUTER), (-OUTER, -OUTER), (OUTER, -OUTER))
OBSTACLE: tuple[Point, ...] = tuple(
    (OBSTACLE_RADIUS * math.cos(angle), OBSTACLE_RADIUS * math.sin(angle))
    for angle in (2 * math.pi * side / OBSTACLE_SIDES for side in range(OBSTACLE_SIDES))
)

# Moves are extended by this length for the wall test. Chipmunk tests whether a segment crosses a wall. A move that ends
# exactly on it does not, nor does the next one, which begins there, so the car would pass through. (Thick walls do not
# help: their round ends leave gaps at the corners.)
_BEYOND = 1e-12
_ANY_WALL = pymunk.ShapeFilter()


class Walls:
    """The outer square and the 36-sided obstacle."""

    def __init__(self) -> None:
        self._space = pymunk.Space()
        for corners in (SQUARE, OBSTACLE):
            for a, b in zip(corners, (*corners[1:], corners[0]), strict=True):
                self._space.add(pymunk.Segment(self._space.static_body, a, b, 0.0))

    def met(self, old: Point, new: Point) -> bool:
        """Whether the straight move from ``old``, on the track, to ``new`` meets a wall."""
        dx, dy = new[0] - old[0], new[1] - old[1]
        length = math.hypot(dx, dy)
        if length == 0:
            return False
        beyond = (new[0] + dx / length * _BEYOND, new[1] + dy / length * _BEYOND)
        return self._space.segment_query_first(old, beyond, 0.0, _ANY_WALL) is not None


def on_track(x: float, y: float) -> bool:
    """Whether a point is inside the square and outside the obstacle, up to rounding."""
    half_angle = math.pi / OBSTACLE_SIDES
    from_edge_middle = math.atan2(y, x) % (2 * half_angle) - half_angle
    height = math.hypot(x, y) * math.cos(from_edge_middle)  # over the centre, across the nearest edge
    return max(abs(x), abs(y)) < OUTER and height > OBSTACLE_RADIUS * math.cos(half_angle) - 1e-9
