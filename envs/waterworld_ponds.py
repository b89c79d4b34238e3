"""Waterworld's physics: pymunk moves the bodies and finds what the agents touch."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pymunk
import pymunk.batch
from numpy.typing import NDArray

from envs.waterworld_maps import BALLS_PER_COLOUR, Palette
from envs.waterworld_rules import RADIUS, finish_move

# At most 32, the bits of a shape's category. Copies share the cost of bulk reads, but overlapping ones are compared in
# every step: steps are cheapest with 8 (14 us per copy; 16 with 4, 21 with 32).
COPIES_PER_SPACE = 8
_POSITION_AND_VELOCITY = pymunk.batch.BodyFields.POSITION | pymunk.batch.BodyFields.VELOCITY
_GROUP = 1  # shared by all shapes, so that nothing collides
_NO_CATEGORY = 0  # matched by no query


class Pond:
    """Up to ``COPIES_PER_SPACE`` copies of Waterworld as kinematic bodies of one pymunk space.

    The copies overlap without interaction: nothing collides, and each copy's query selects its own balls by category. A
    shared space makes bulk reads worthwhile.

    Attributes:
        states: x, y, vx, vy of the bodies after the last ``move``, or for the next ``write``: shape (4, copies, balls +
            1), a view of the batch.
    """

    def __init__(self, states: NDArray[np.float64]) -> None:
        """Create the bodies, placed by ``write``; three balls per colour, the agent last."""
        _, copies, bodies = states.shape
        self.states = states
        self._space = pymunk.Space()
        # Everything moves far in each step, so spatial hashing is faster than pymunk's default tree.
        self._space.use_spatial_hash(4 * RADIUS, 1000)
        self._shapes: list[Any] = []
        self._colour: dict[Any, int] = {}
        for copy in range(copies):
            for number in range(bodies - 1):
                self._colour[self._add(1 << copy)] = number // BALLS_PER_COLOUR
            self._add(_NO_CATEGORY)
        self._agents = self._shapes[bodies - 1 :: bodies]
        self._own_balls = [pymunk.ShapeFilter(mask=1 << copy) for copy in range(copies)]
        self._rows = np.empty((copies, bodies, 4))  # in pymunk's order, that of adding
        self._read = pymunk.batch.Buffer()
        self._written = pymunk.batch.Buffer()
        self._written.set_float_buf(self._rows)

    def _add(self, category: int) -> Any:
        body = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        shape = pymunk.Circle(body, RADIUS)
        shape.filter = pymunk.ShapeFilter(group=_GROUP, categories=category)
        self._space.add(body, shape)
        self._shapes.append(shape)
        return shape

    def write(self, displaced: Iterable[int]) -> None:
        """Set the bodies to ``states``.

        Args:
            displaced: bodies, as copy*(balls + 1) + number, whose positions changed since the last ``move``. Queries
                would miss them without updating the space's cached bounding boxes.
        """
        self._rows[:] = self.states.transpose(1, 2, 0)
        pymunk.batch.set_space_bodies(self._space, _POSITION_AND_VELOCITY, self._written)
        for body in displaced:
            self._space.reindex_shape(self._shapes[body])

    def touched(self) -> list[tuple[int, int]]:
        """Every (copy, colour) of a ball whose bounding box meets the agent's, borders included.

        Quirk: balls are round, but touching is tested on boxes, |dx| <= 1 and |dy| <= 1.
        """
        query = self._space.bb_query
        return [
            (copy, self._colour[ball])
            for copy, (agent, own_balls) in enumerate(zip(self._agents, self._own_balls, strict=True))
            for ball in query(agent.bb, own_balls)
        ]

    def move(self) -> None:
        """Move every body by its velocity for one time unit and update ``states``."""
        self._space.step(1.0)
        self._read.clear()
        pymunk.batch.get_space_bodies(self._space, _POSITION_AND_VELOCITY, self._read)
        rows = np.frombuffer(self._read.float_buf()).reshape(self._rows.shape)
        self.states[:] = rows.transpose(2, 0, 1)


class Ponds:
    """N copies of Waterworld, and the rules of a step.

    Attributes:
        states: float64 (4, N, balls + 1), the current states; read-only.
    """

    def __init__(self, palette: Palette, count: int) -> None:
        """Create ``count`` copies with everything at (0, 0) until ``put``."""
        self._colours = len(palette.colours)
        self.states = np.zeros((4, count, palette.balls + 1))
        self._first_copies = range(0, count, COPIES_PER_SPACE)
        self._ponds = [Pond(self.states[:, i : i + COPIES_PER_SPACE]) for i in self._first_copies]
        self.put(np.arange(count), self.states.copy())

    def put(self, rows: NDArray[np.intp], states: NDArray[np.float64]) -> None:
        """Set the copies ``rows`` to states of shape (4, len(rows), balls + 1)."""
        self.states[:, rows] = states
        displaced = np.zeros(self.states.shape[1:], dtype=np.bool_)
        displaced[rows] = True
        self._write(displaced)

    def touches(self) -> NDArray[np.bool_]:
        """Colours that the agents touch now: bool (N, colours)."""
        touches = np.zeros((self.states.shape[1], self._colours), dtype=np.bool_)
        for first, pond in zip(self._first_copies, self._ponds, strict=True):
            for copy, colour in pond.touched():
                touches[first + copy, colour] = True
        return touches

    def step(self, commands: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Step every copy by commanded velocities, shape (N, 2).

        Returns:
            Labels, bool (N, colours). Quirk: they describe the positions *before* the move, so the automaton is one
            step behind the observations.
        """
        labels = self.touches()
        for pond in self._ponds:
            pond.move()
        self._write(finish_move(self.states, commands))
        return labels

    def _write(self, displaced: NDArray[np.bool_]) -> None:
        for first, pond in zip(self._first_copies, self._ponds, strict=True):
            pond.write(np.flatnonzero(displaced[first : first + COPIES_PER_SPACE]).tolist())
