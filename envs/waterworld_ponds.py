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

# At most 32, the bits of a shape's category. Copies share the cost of bulk reads, but those that lie on top of
# each other are compared in every step: 8 is where a step is cheapest (14 us a copy; 16 with 4, 21 with 32).
COPIES_PER_SPACE = 8
_POSITION_AND_VELOCITY = pymunk.batch.BodyFields.POSITION | pymunk.batch.BodyFields.VELOCITY
_GROUP = 1  # of all shapes, so that balls pass through each other and through the agent
_NO_CATEGORY = 0  # what no query asks for


class Pond:
    """Up to ``COPIES_PER_SPACE`` copies of Waterworld as kinematic bodies of one pymunk space.

    The copies lie on top of each other and do not notice: nothing collides, and the balls of each copy have a
    category of their own, for which the copy's query asks. A common space makes bulk reads worth their while.

    Attributes:
        states: array of shape (4, copies, balls + 1), a view of the batch: x, y, vx, vy of the bodies as of
            the last ``move``, or as they are to be after the next ``write``.
    """

    def __init__(self, states: NDArray[np.float64]) -> None:
        """Make the bodies, which are nowhere until ``write``; three balls per colour, the agent last."""
        _, copies, bodies = states.shape
        self.states = states
        self._space = pymunk.Space()
        # Everything moves far in each step: hashing by place is faster then than pymunk's usual tree.
        self._space.use_spatial_hash(4 * RADIUS, 1000)
        self._shapes: list[Any] = []
        self._colour: dict[Any, int] = {}
        for copy in range(copies):
            for number in range(bodies - 1):
                self._colour[self._add(1 << copy)] = number // BALLS_PER_COLOUR
            self._add(_NO_CATEGORY)
        self._agents = self._shapes[bodies - 1 :: bodies]
        self._own_balls = [pymunk.ShapeFilter(mask=1 << copy) for copy in range(copies)]
        self._rows = np.empty((copies, bodies, 4))  # in the order in which bodies were added, as pymunk reads
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
        """Put the bodies where ``states`` says.

        Args:
            displaced: bodies, as copy*(balls + 1) + number, whose positions have changed since the last
                ``move``. Their bounding boxes are cached in the space: queries would miss them otherwise.
        """
        self._rows[:] = self.states.transpose(1, 2, 0)
        pymunk.batch.set_space_bodies(self._space, _POSITION_AND_VELOCITY, self._written)
        for body in displaced:
            self._space.reindex_shape(self._shapes[body])

    def touched(self) -> list[tuple[int, int]]:
        """Every (copy, colour) of a ball whose bounding box meets the agent's, borders included.

        Quirk: balls are round, but touching is decided by boxes, |dx| <= 1 and |dy| <= 1.
        """
        query = self._space.bb_query
        return [
            (copy, self._colour[ball])
            for copy, (agent, own_balls) in enumerate(zip(self._agents, self._own_balls, strict=True))
            for ball in query(agent.bb, own_balls)
        ]

    def move(self) -> None:
        """One time unit: every body moves by its velocity; ``states`` follows."""
        self._space.step(1.0)
        self._read.clear()
        pymunk.batch.get_space_bodies(self._space, _POSITION_AND_VELOCITY, self._read)
        rows = np.frombuffer(self._read.float_buf()).reshape(self._rows.shape)
        self.states[:] = rows.transpose(2, 0, 1)


class Ponds:
    """N copies of Waterworld, and the rules of a step.

    Attributes:
        states: float64 array of shape (4, N, balls + 1), the present states; for reading.
    """

    def __init__(self, palette: Palette, count: int) -> None:
        """Make ``count`` copies with everything at (0, 0) until ``put``."""
        self._colours = len(palette.colours)
        self.states = np.zeros((4, count, palette.balls + 1))
        self._first_copies = range(0, count, COPIES_PER_SPACE)
        self._ponds = [Pond(self.states[:, i : i + COPIES_PER_SPACE]) for i in self._first_copies]
        self.put(np.arange(count), self.states.copy())

    def put(self, rows: NDArray[np.intp], states: NDArray[np.float64]) -> None:
        """Put the copies ``rows`` into states of shape (4, len(rows), balls + 1)."""
        self.states[:, rows] = states
        displaced = np.zeros(self.states.shape[1:], dtype=np.bool_)
        displaced[rows] = True
        self._write(displaced)

    def touches(self) -> NDArray[np.bool_]:
        """What the agents touch now: bool array of shape (N, colours)."""
        touches = np.zeros((self.states.shape[1], self._colours), dtype=np.bool_)
        for first, pond in zip(self._first_copies, self._ponds, strict=True):
            for copy, colour in pond.touched():
                touches[first + copy, colour] = True
        return touches

    def step(self, commands: NDArray[np.float64]) -> NDArray[np.bool_]:
        """One step of every copy.

        Args:
            commands: array of shape (N, 2), the commanded velocities.

        Returns:
            Labels, bool array of shape (N, colours). Quirk: they are of the positions *before* the move, so
            the automaton lags a step behind what is observed.
        """
        labels = self.touches()
        for pond in self._ponds:
            pond.move()
        self._write(finish_move(self.states, commands))
        return labels

    def _write(self, displaced: NDArray[np.bool_]) -> None:
        for first, pond in zip(self._first_copies, self._ponds, strict=True):
            pond.write(np.flatnonzero(displaced[first : first + COPIES_PER_SPACE]).tolist())
