"""Renders Racecar."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from envs.racecar_track import OBSTACLE, OUTER, START, TARGET_RADIUS, TARGETS
from envs.rendering import BLUE, DARK, GREEN, GREY, LABEL_BAND_HEIGHT, ORANGE, WHITE, Canvas

_SCALE = 150  # pixels per unit
_HALF_WIDTH = 250  # pixels


def _pixels(x: float, y: float) -> tuple[float, float]:
    """Pixel coordinates of a track position."""
    return _HALF_WIDTH + x * _SCALE, _HALF_WIDTH - y * _SCALE


def render_track(state: list[float], propositions: tuple[str, ...], labels: frozenset[str]) -> NDArray[np.uint8]:
    """Render one state with its labels: uint8 (536, 500, 3)."""
    canvas = Canvas(2 * _HALF_WIDTH, 2 * _HALF_WIDTH + LABEL_BAND_HEIGHT, DARK)
    inside = (*_pixels(-OUTER, OUTER), *_pixels(OUTER, -OUTER))
    canvas.rectangle(inside, fill=(238, 240, 242))
    _draw_targets(canvas, labels)
    canvas.polygon([_pixels(x, y) for x, y in OBSTACLE], DARK)
    x, y = _pixels(*START)
    canvas.line([(x - 7, y - 7), (x + 7, y + 7)], GREY, 2)
    canvas.line([(x - 7, y + 7), (x + 7, y - 7)], GREY, 2)
    canvas.text(x, y + 16, "start", GREY, 12)
    _draw_car(canvas, state)
    if state[9]:
        canvas.text(_HALF_WIDTH, _HALF_WIDTH, "hit!", WHITE, 20)
    canvas.label_band(propositions, labels)
    return canvas.to_array()


def _draw_targets(canvas: Canvas, labels: frozenset[str]) -> None:
    """Discs with their names, paler while not reported."""
    for number, (x, y) in enumerate(TARGETS, start=1):
        fill = GREEN if f"g{number}" in labels else (188, 228, 214)
        canvas.disc(*_pixels(x, y), TARGET_RADIUS * _SCALE, fill=fill, outline=GREEN, width=2)
        canvas.text(*_pixels(x, y), f"g{number}", DARK, 18)


def _draw_car(canvas: Canvas, state: list[float]) -> None:
    """A disc with an arrow for its velocity per time unit."""
    x, y, vx, vy = state[:4]
    canvas.line([_pixels(x, y), _pixels(x + vx, y + vy)], ORANGE, 3)
    canvas.disc(*_pixels(x, y), 7, fill=BLUE, outline=WHITE, width=2)
