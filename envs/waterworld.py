"""Waterworld: N ponds, moved by pymunk and observed together, and a single one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.utils.seeding import np_random
from numpy.typing import ArrayLike, NDArray

from envs.action_checks import checked_box_actions, symmetric_box
from envs.batch_of_one import BatchOfOne
from envs.snapshot_batch import Rows, SnapshotBatch
from envs.waterworld_maps import Palette, checked_map, palette_of, starting_balls
from envs.waterworld_ponds import Ponds
from envs.waterworld_rules import (
    START,
    TOP_COMMAND,
    Observation,
    checked_states,
    observation_space,
    observe,
    to_snapshots,
    to_states,
)


class WaterworldVectorEnv(SnapshotBatch):
    """N ponds as described in ``WaterworldEnv``.

    With ``map="random"``, row i reset with seed s has the maps of a single environment reset with s + i.
    """

    metadata = {**SnapshotBatch.metadata, "render_fps": 10}  # noqa: RUF012 - gymnasium's own convention

    def __init__(
        self,
        num_envs: int = 1,
        colours: int = 6,
        map: int | str = "paper",
        observation: Observation = "features",
        render_mode: str | None = None,
    ) -> None:
        """Make ``num_envs`` ponds in a start state; other arguments as for ``WaterworldEnv``.

        Raises:
            ValueError: if an argument is invalid.
        """
        self.palette = palette_of(colours)
        self._commands = symmetric_box(TOP_COMMAND, 2)
        observed = observation_space(self.palette, observation)
        super().__init__(num_envs, self.palette.colours, observed, self._commands, render_mode)
        self._map = checked_map(map)
        self._observation = observation
        self.generators = [np_random()[0] for _ in range(num_envs)]
        self._ponds = Ponds(self.palette, num_envs)
        self._reported = self._ponds.touches()
        self._start(np.arange(num_envs), None)

    def _start(self, rows: Rows, seed: int | None) -> None:
        if seed is not None:
            for row in rows.tolist():
                self.generators[row] = np_random(seed + row)[0]
        self._put(rows, start_states(self.palette, self._map, [self.generators[row] for row in rows]))

    def _advance(self, actions: ArrayLike) -> NDArray[np.bool_]:
        commands = checked_box_actions(self._commands, TOP_COMMAND, actions, (self.num_envs, 2))
        self._reported = self._ponds.step(commands)
        return np.zeros(self.num_envs, dtype=np.bool_)

    def _observe(self) -> NDArray[np.float32]:
        return observe(self.palette, self._ponds.states, self._observation)

    def _labels(self) -> NDArray[np.bool_]:
        return self._reported.copy()

    def _snapshots(self, rows: Rows) -> NDArray[np.float64]:
        return to_snapshots(self._ponds.states[:, rows])

    def _restore(self, rows: Rows, snapshots: NDArray[Any]) -> NDArray[np.float32]:
        restored = checked_states(self.palette, snapshots, rows.size)
        self._put(rows, restored)
        return observe(self.palette, restored, self._observation)

    def _put(self, rows: Rows, states: NDArray[np.float64]) -> None:
        """Set ``rows`` to states (4, k, balls + 1) and report what is touched there."""
        self._ponds.put(rows, states)
        self._reported[rows] = self._ponds.touches()[rows]

    def _picture(self, row: int) -> NDArray[np.uint8]:
        from envs.waterworld_drawing import render_pond

        return render_pond(self.palette, self._ponds.states[:, row], self._reported[row])


class WaterworldEnv(BatchOfOne):
    """One pond of balls; id ``t4nmtd/Waterworld-v0``, contract in ``envs.protocol.SnapshotEnv``.

    The agent and three balls of each colour move in a field of 30 by 30; balls move straight and bounce off walls.
    Nothing collides. pymunk computes motion and touches.

    Action: a velocity in [-3.5, 3.5]^2, effective in the *next* step.

    Labels: the colours of the balls that touched the agent *before* the step's move. At reset, and when rendering after
    ``set_state``, those touched there, which the first step reports again. The environment never terminates.

    Observation ``"features"``: 144 numbers in [-1, 1] for 6 colours, 190 for 8.

    - agent: position (-1 to 1), velocity (by 3.5), and per axis 1 if a wall makes the coming step ignore its command;
    - per colour 1 if the coming step will report it; then per colour 1 if the step after it will: the agent can no
      longer influence either;
    - per ball, by colour in the order of ``propositions`` and nearest first: 1 if some command can touch it, and then
      the command (by 4.5) that would put the agent's centre on the ball's two moves from now, the first position the
      present command can reach (0 on an axis whose command is ignored), else 0, 0; the current offset from the agent
      (by 240); and the ball's velocity (by 8 times its top speed). A command touches the ball if it is off by at most 1
      per axis. The last four numbers are small so that distant balls do not drown the few within reach.

    Observation ``"raw"``, the authors' 76 or 100 numbers: x, y, vx, vy of each ball, then of the agent.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - gymnasium's own convention

    def __init__(
        self,
        colours: int = 6,
        map: int | str = "paper",
        observation: Observation = "features",
        render_mode: str | None = None,
    ) -> None:
        """Make a pond in a start state.

        Args:
            colours: 6 (18 balls, task 1) or 8 (24 balls, task 2).
            map: "paper", a seed for one fixed map, or "random" for a new map at every reset.
            observation: "features" or "raw".
            render_mode: None or "rgb_array".

        Raises:
            ValueError: if an argument is invalid.
        """
        super().__init__(WaterworldVectorEnv(1, colours, map, observation, render_mode))


def start_states(palette: Palette, choice: int | str, generators: Sequence[np.random.Generator]) -> NDArray[np.float64]:
    """States after a reset, shape (4, N, balls + 1); ``choice`` is the keyword ``map``."""
    maps = [np.append(starting_balls(palette, choice, generator), START) for generator in generators]
    return to_states(np.stack(maps))
