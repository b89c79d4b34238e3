"""Renders FrozenLake."""

from __future__ import annotations

from itertools import compress

import numpy as np
from numpy.typing import NDArray

from envs.frozenlake_rules import CARRYING, CELL, CELLS, ENDED, FIRST_PASSENGER, PASSENGERS, SIDE, Lake, label_rows
from envs.rendering import (
    BLACK,
    BLUE,
    DARK,
    GREEN,
    GREY,
    LABEL_BAND_HEIGHT,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    WHITE,
    YELLOW,
    Canvas,
)

_TILE = 48  # pixels


def render_lake(lake: Lake, state: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Render one state with its labels: uint8 (420, 384, 3)."""
    canvas = Canvas(SIDE * _TILE, SIDE * _TILE + LABEL_BAND_HEIGHT, WHITE)
    for cell in range(CELLS):
        _draw_tile(canvas, lake, cell)
    for number in range(1, PASSENGERS + 1):
        cell = int(state[FIRST_PASSENGER + number - 1])
        if cell >= 0:
            x, y = _centre(cell)
            _draw_passenger(canvas, x - 10, y + 10, number)
    _draw_agent(canvas, *_centre(int(state[CELL])), int(state[CARRYING]), bool(state[ENDED]))
    labels = set(compress(lake.propositions, label_rows(lake, state[None])[0]))
    canvas.label_band(lake.propositions, labels, "ended" if state[ENDED] else "")
    return canvas.to_array()


def _centre(cell: int) -> tuple[float, float]:
    row, column = divmod(cell, SIDE)
    return (column + 0.5) * _TILE, (row + 0.5) * _TILE


def _draw_tile(canvas: Canvas, lake: Lake, cell: int) -> None:
    """Ice, with a hole, a goal's flag, or the start mark."""
    x, y = _centre(cell)
    half = _TILE / 2
    ice = (226, 240, 250)
    canvas.rectangle((x - half, y - half, x + half, y + half), fill=ice, outline=WHITE)
    tile = lake.tiles[cell]
    if tile == "H":
        canvas.disc(x, y, half - 5, fill=(16, 42, 67), outline=SKY, width=2)
    elif tile == "G":
        name = lake.propositions[PASSENGERS + lake.tiles[:cell].count("G")]
        canvas.rectangle((x - half + 2, y - half + 2, x + half - 2, y + half - 2), outline=GREEN, width=3)
        canvas.line([(x - 19, y + 17), (x - 19, y - 18)], DARK, 2)
        canvas.rectangle((x - 19, y - 19, x + 1, y - 4), fill=GREEN)
        canvas.text(x - 9, y - 11.5, name, WHITE, 13)
    elif tile == "S":
        canvas.text(x, y, "S", GREY, 20)


def _draw_passenger(canvas: Canvas, x: float, y: float, number: int) -> None:
    """A numbered disc, one colour per passenger."""
    canvas.disc(x, y, 10, fill=(ORANGE, PURPLE, YELLOW)[number - 1], outline=WHITE, width=2)
    canvas.text(x, y, str(number), BLACK, 14)


def _draw_agent(canvas: Canvas, x: float, y: float, carrying: int, ended: bool) -> None:
    """A figure, red after termination, its passenger overhead."""
    colour = VERMILION if ended else BLUE
    x += 10
    canvas.polygon([(x - 11, y + 22), (x, y + 2), (x + 11, y + 22)], colour)
    canvas.disc(x, y + 3, 8, fill=colour, outline=WHITE, width=1.5)
    if carrying:
        _draw_passenger(canvas, x, y - 12, carrying)
