"""Renders HalfCheetah's side view and markers from its capsules, without OpenGL."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.halfcheetah_rules import MARKER_REACH, MARKERS
from envs.rendering import BLUE, DARK, GREEN, GREY, LABEL_BAND_HEIGHT, ORANGE, PALE, VERMILION, WHITE, Canvas

_WIDTH = 640
_MAP_HEIGHT = 60
_VIEW_HEIGHT = 260
_GROUND = _MAP_HEIGHT + _VIEW_HEIGHT - 40  # pixels from the top
_SCALE = 110  # pixels per metre in the view
_MAP_SCALE = 28  # pixels per metre on the map
_MAP_END = 11.0  # metres to either side
_FRONT = ("head", "fthigh", "fshin", "ffoot")


def render_side_view(
    model: Any, positions: NDArray[np.float64], propositions: Sequence[str], labels: Collection[str]
) -> NDArray[np.uint8]:
    """A map of all markers above a view that follows the body: uint8 array (356, 640, 3).

    ``positions`` is qpos, shape (9,); ``labels`` are the true ``propositions``.
    """
    canvas = Canvas(_WIDTH, _MAP_HEIGHT + _VIEW_HEIGHT + LABEL_BAND_HEIGHT, (226, 238, 247))
    x = float(positions[0])
    canvas.rectangle((0, _GROUND, _WIDTH, _MAP_HEIGHT + _VIEW_HEIGHT), fill=(205, 196, 180))
    _draw_metres(canvas, x)
    for name, marker in zip(propositions, MARKERS, strict=True):
        _draw_flag(canvas, _WIDTH / 2 + (marker - x) * _SCALE, name, name in labels)
    _draw_body(canvas, model, positions)
    _draw_map(canvas, x, propositions, labels)
    canvas.label_band(propositions, labels, f"x = {x:.2f}")
    return canvas.to_array()


def _draw_metres(canvas: Canvas, x: float) -> None:
    """Ticks and numbers for every visible metre."""
    reach = int(_WIDTH / 2 / _SCALE) + 1
    for metre in range(round(x) - reach, round(x) + reach + 1):
        at = _WIDTH / 2 + (metre - x) * _SCALE
        canvas.line([(at, _GROUND), (at, _GROUND + 8)], GREY, 2)
        canvas.text(at, _GROUND + 20, str(metre), DARK, 12)


def _draw_flag(canvas: Canvas, at: float, name: str, reached: bool) -> None:
    """A marker's zone on the ground and its flag."""
    colour = GREEN if reached else VERMILION
    zone = MARKER_REACH * _SCALE
    canvas.rectangle((at - zone, _GROUND, at + zone, _GROUND + 6), fill=colour)
    canvas.line([(at, _GROUND), (at, _MAP_HEIGHT + 14)], colour, 2)
    canvas.rectangle((at, _MAP_HEIGHT + 14, at + 36, _MAP_HEIGHT + 38), fill=colour)
    canvas.text(at + 18, _MAP_HEIGHT + 26, name, WHITE, 16)


def _draw_body(canvas: Canvas, model: Any, positions: NDArray[np.float64]) -> None:
    """Capsules as thick lines, front and back in different colours."""
    # Uses separate data: kinematics on the environment's data would change its next step.
    data = mujoco.MjData(model)
    data.qpos[:] = positions
    mujoco.mj_kinematics(model, data)
    for geom in range(model.ngeom):
        if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_CAPSULE:
            continue
        radius, half_length = model.geom_size[geom, :2]
        along = data.geom_xmat[geom].reshape(3, 3)[:, 2] * half_length
        ends = [data.geom_xpos[geom] + side * along - (positions[0], 0, 0) for side in (-1, 1)]
        points = [(_WIDTH / 2 + end[0] * _SCALE, _GROUND - end[2] * _SCALE) for end in ends]
        name = model.geom(geom).name
        colour = DARK if name == "torso" else ORANGE if name in _FRONT else BLUE
        canvas.line(points, colour, 2 * radius * _SCALE)
        for place in points:
            canvas.disc(*place, radius * _SCALE, fill=colour)


def _draw_map(canvas: Canvas, x: float, propositions: Sequence[str], labels: Collection[str]) -> None:
    """Map of the ground with all markers and the cheetah's position."""
    middle = _MAP_HEIGHT - 18
    canvas.rectangle((0, 0, _WIDTH, _MAP_HEIGHT), fill=PALE)
    canvas.line([(_WIDTH / 2 + side * _MAP_END * _MAP_SCALE, middle) for side in (-1, 1)], GREY, 3)
    for name, marker in zip(propositions, MARKERS, strict=True):
        at = _WIDTH / 2 + marker * _MAP_SCALE
        colour = GREEN if name in labels else VERMILION
        zone = MARKER_REACH * _MAP_SCALE
        canvas.rectangle((at - zone, middle - 5, at + zone, middle + 5), fill=colour)
        canvas.text(at, middle - 22, name, DARK, 14)
    at = _WIDTH / 2 + min(max(x, -_MAP_END), _MAP_END) * _MAP_SCALE
    canvas.polygon([(at, middle + 4), (at - 7, middle + 16), (at + 7, middle + 16)], BLUE)
