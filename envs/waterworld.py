"""Waterworld: the single environment, and how it is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from envs.box_actions import checked_box_actions, symmetric_box
from envs.protocol import checked_choice
from envs.waterworld_maps import BALLS_PER_COLOUR, SIDE, Palette, checked_map, palette_of, starting_balls
from envs.waterworld_ponds import Ponds
from envs.waterworld_rules import (
    AGENT,
    RADIUS,
    START,
    TOP_COMMAND,
    Observation,
    checked_states,
    observation_space,
    observe,
    to_snapshots,
    to_states,
)

_SCALE = 16  # pixels per unit
_MARGIN = 12  # pixels around the field


class WaterworldEnv(gymnasium.Env[NDArray[Any], Any]):
    """One pond of balls; id ``t4nmtd/Waterworld-v0``, contract in ``envs.protocol.SnapshotEnv``.

    The agent and three balls of each colour move in a field of 30 by 30, the balls by straight lines that
    walls reflect. Nothing collides. Motion and touches are pymunk's.

    Action: a velocity in [-3.5, 3.5]^2, which takes effect in the *next* step.

    Labels: the colours of the balls that touched the agent *before* the move of the step. At reset, and
    after ``set_state`` in a picture, those touched there, which the first step reports once more. An environment
    never terminates.

    Observation ``"features"``: 144 numbers in [-1, 1] for 6 colours, 190 for 8.

    - agent: position (-1 to 1), velocity (by 3.5), and per axis 1 if a wall makes the coming step ignore its
      command;
    - for each colour 1 if the coming step will report it; then for each colour 1 if the step after it will:
      both are beyond the agent's power by now;
    - for each ball, colour by colour in the order of ``propositions`` and within a colour the nearest first:
      1 if some command can touch it, and then the command (by 4.5) that would put the agent's centre on the
      ball's two moves from now, which is the first place the present command can reach (0 on an axis whose
      command is ignored), or 0, 0; the offset from the agent to the ball now (by 240); and the ball's velocity
      (by 8 times its top speed). A command touches the ball if it is off by at most 1 per axis. The last four
      numbers are small so that the few balls within reach are not drowned by the many that are not.

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
            map: "paper", a seed for a map that is drawn once, or "random" for a fresh map at every reset.
            observation: "features" or "raw".
            render_mode: None or "rgb_array".

        Raises:
            ValueError: if an argument is none of these.
        """
        checked_choice("render_mode", render_mode, (None, "rgb_array"))
        self.palette = palette_of(colours)
        self.propositions: tuple[str, ...] = self.palette.colours
        self.observation_space = observation_space(self.palette, observation)
        self.action_space = self._commands = symmetric_box(TOP_COMMAND, 2)
        self.render_mode = render_mode
        self._map = checked_map(map)
        self._observation = observation
        self._ponds = Ponds(self.palette, 1)
        self._put(start_states(self.palette, self._map, [self.np_random]))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """The agent in the middle at rest, the balls as the map says. Options are ignored.

        Args:
            seed: decides the maps of ``map="random"``; without effect otherwise.
            options: ignored.
        """
        super().reset(seed=seed)
        self._put(start_states(self.palette, self._map, [self.np_random]))
        return self._observe(), self._info()

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Command a velocity, array of shape (2,).

        Raises:
            ValueError: if ``action`` has another shape or type, holds NaN or is not within +-3.5.
        """
        command = checked_box_actions(self._commands, TOP_COMMAND, action, (2,))
        self._labels = self._ponds.step(command[None])
        return self._observe(), 0.0, False, False, self._info()

    def get_state(self) -> NDArray[np.float64]:
        """A snapshot: float64 array of shape (76,) or (100,), see ``envs.waterworld_rules``."""
        snapshot: NDArray[np.float64] = to_snapshots(self._ponds.states)[0]
        return snapshot

    def set_state(self, state: NDArray[Any]) -> NDArray[np.float32]:
        """Restore a snapshot; returns the observation there.

        Raises:
            ValueError: if ``state`` is no snapshot of a Waterworld with these colours; nothing changes then.
        """
        self._put(checked_states(self.palette, state[None] if isinstance(state, np.ndarray) else state, 1))
        return self._observe()

    def render(self) -> NDArray[np.uint8] | None:
        """The pond and its labels, uint8 array of shape (540, 504, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        return render_pond(self.palette, self._ponds.states[:, 0], self._labels[0])

    def _put(self, states: NDArray[np.float64]) -> None:
        self._ponds.put([0], states)
        self._labels = self._ponds.touches()

    def _observe(self) -> NDArray[np.float32]:
        observation: NDArray[np.float32] = observe(self.palette, self._ponds.states, self._observation)[0]
        return observation

    def _info(self) -> dict[str, Any]:
        return {"labels": frozenset(compress(self.propositions, self._labels[0]))}


def start_states(palette: Palette, choice: int | str, generators: Sequence[np.random.Generator]) -> NDArray[np.float64]:
    """States after a reset, array of shape (4, N, balls + 1).

    Args:
        palette: the colours.
        choice: the constructor keyword ``map``.
        generators: N of them, for random maps.
    """
    maps = [np.append(starting_balls(palette, choice, generator), START) for generator in generators]
    return to_states(np.stack(maps))


def render_pond(palette: Palette, state: NDArray[np.float64], labels: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A picture of one state (4, balls + 1) with labels (colours,): uint8 array of shape (540, 504, 3)."""
    from envs.rendering import GREY, LABEL_BAND_HEIGHT, PALE, Canvas

    size = SIDE * _SCALE + 2 * _MARGIN
    canvas = Canvas(size, size + LABEL_BAND_HEIGHT, PALE)
    edges = (_MARGIN, _MARGIN, size - _MARGIN, size - _MARGIN)
    canvas.rectangle(edges, fill=(190, 220, 238), outline=GREY, width=2)
    for number, ball in enumerate(state.T[:AGENT]):
        _draw_ball(canvas, ball, _paint()[palette.colours[number // BALLS_PER_COLOUR]])
    _draw_agent(canvas, state.T[AGENT])
    canvas.label_band(palette.colours, set(compress(palette.colours, labels)))
    return canvas.to_array()


def _paint() -> dict[str, Any]:
    from envs.rendering import BLACK, WHITE

    return {
        "red": (214, 39, 40),
        "green": (34, 150, 60),
        "blue": (31, 80, 200),
        "pink": (255, 130, 190),
        "black": BLACK,
        "white": WHITE,
        "grey": (128, 132, 138),
        "yellow": (245, 215, 30),
    }


def _pixels(x: float, y: float) -> tuple[float, float]:
    """Where a place of the field is in the picture; y points up in the field."""
    return _MARGIN + x * _SCALE, _MARGIN + (SIDE - y) * _SCALE


def _draw_ball(canvas: Any, ball: NDArray[np.float64], colour: Any) -> None:
    """A disc, and a line to where it will be after the next step."""
    from envs.rendering import DARK

    x, y = _pixels(ball[0], ball[1])
    canvas.line([(x, y), _pixels(ball[0] + ball[2], ball[1] + ball[3])], colour, 2)
    canvas.disc(x, y, RADIUS * _SCALE, fill=colour, outline=DARK, width=1)


def _draw_agent(canvas: Any, agent: NDArray[np.float64]) -> None:
    """An orange disc, the box within which centres of balls touch it, and its velocity."""
    from envs.rendering import DARK, ORANGE

    x, y = _pixels(agent[0], agent[1])
    reach = 2 * RADIUS * _SCALE
    canvas.line([(x, y), _pixels(agent[0] + agent[2], agent[1] + agent[3])], ORANGE, 3)
    canvas.rectangle((x - reach, y - reach, x + reach, y + reach), outline=DARK, width=1.5)
    canvas.disc(x, y, RADIUS * _SCALE, fill=ORANGE, outline=DARK, width=2)
    canvas.text(x, y, "A", DARK, 12)
