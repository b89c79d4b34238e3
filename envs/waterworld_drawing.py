"""Renders Waterworld."""

from __future__ import annotations

from itertools import compress

import numpy as np
from numpy.typing import NDArray

from envs.rendering import BLACK, DARK, GREY, LABEL_BAND_HEIGHT, ORANGE, PALE, WHITE, Canvas, Colour
from envs.waterworld_maps import BALLS_PER_COLOUR, SIDE, Palette
from envs.waterworld_rules import AGENT, RADIUS

_SCALE = 16  # pixels per unit
_MARGIN = 12  # pixels around the field
_PAINT: dict[str, Colour] = {
    "red": (214, 39, 40),
    "green": (34, 150, 60),
    "blue": (31, 80, 200),
    "pink": (255, 130, 190),
    "black": BLACK,
    "white": WHITE,
    "grey": (128, 132, 138),
    "yellow": (245, 215, 30),
}


def render_pond(palette: Palette, state: NDArray[np.float64], labels: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Render one state (4, balls + 1) with labels (colours,): uint8 (540, 504, 3)."""
    size = SIDE * _SCALE + 2 * _MARGIN
    canvas = Canvas(size, size + LABEL_BAND_HEIGHT, PALE)
    edges = (_MARGIN, _MARGIN, size - _MARGIN, size - _MARGIN)
    canvas.rectangle(edges, fill=(190, 220, 238), outline=GREY, width=2)
    for number, ball in enumerate(state.T[:AGENT]):
        _draw_ball(canvas, ball, _PAINT[palette.colours[number // BALLS_PER_COLOUR]])
    _draw_agent(canvas, state.T[AGENT])
    canvas.label_band(palette.colours, set(compress(palette.colours, labels)))
    return canvas.to_array()


def _pixels(x: float, y: float) -> tuple[float, float]:
    """Pixel coordinates of a field position."""
    return _MARGIN + x * _SCALE, _MARGIN + (SIDE - y) * _SCALE


def _draw_ball(canvas: Canvas, ball: NDArray[np.float64], colour: Colour) -> None:
    """A disc, and a line to its next position."""
    x, y = _pixels(ball[0], ball[1])
    canvas.line([(x, y), _pixels(ball[0] + ball[2], ball[1] + ball[3])], colour, 2)
    canvas.disc(x, y, RADIUS * _SCALE, fill=colour, outline=DARK, width=1)


def _draw_agent(canvas: Canvas, agent: NDArray[np.float64]) -> None:
    """An orange disc, its touch box, and its velocity."""
    x, y = _pixels(agent[0], agent[1])
    reach = 2 * RADIUS * _SCALE
    canvas.line([(x, y), _pixels(agent[0] + agent[2], agent[1] + agent[3])], ORANGE, 3)
    canvas.rectangle((x - reach, y - reach, x + reach, y + reach), outline=DARK, width=1.5)
    canvas.disc(x, y, RADIUS * _SCALE, fill=ORANGE, outline=DARK, width=2)
    canvas.text(x, y, "A", DARK, 12)
