"""Racecar (tasks 5 and 6): a point mass with two thrusters on a walled square, from the IPPC 2023 domain.

A snapshot is 10 float64: x, y, vx, vy; the four target distances and the wall flag that the last step
reported; and 1 if that step ended at a wall, so that the next one reports it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from envs.box_actions import checked_box_actions, symmetric_box
from envs.protocol import checked_choice, checked_snapshots
from envs.racecar_track import (
    DISTANCE_BOUND,
    OBSTACLE,
    OBSTACLE_RADIUS,
    OUTER,
    START,
    TARGET_RADIUS,
    TARGETS,
    Walls,
    on_track,
)

if TYPE_CHECKING:
    from envs.rendering import Canvas

Observation = Literal["features", "raw"]

TOP_FORCE = 1.0
TOP_SPEED = 0.5
DT = 0.1
STATE_SIZE = 10
_HALF_DT_SQUARED = DT**2 / 2
_FARTHEST_AXIS = OUTER + max(abs(x) for x, _ in TARGETS)  # from a target, along one axis
_FEATURES = 4 + 2 + 1 + len(TARGETS) * 4
_SCALE = 150  # pixels per unit
_HALF_WIDTH = 250  # pixels


class RacecarEnv(gymnasium.Env[NDArray[Any], Any]):
    """One car; id ``t4nmtd/Racecar-v0``, contract in ``envs.protocol.SnapshotEnv``.

    Action: forces in [-1, 1]^2 on a mass of 1 for 0.1 time units; speed is clipped to 0.5 per axis, friction
    there is none. A move that meets a wall, the outer square or the obstacle in the middle, puts the car back
    to the start, at rest.

    Labels: ``g1`` to ``g4`` if the car was in that target *before* the move of the step; ``wall`` if the step
    before met a wall. At reset those that the first step reports, hence none. An environment never terminates.

    Observation ``"features"``, 23 numbers in [-1, 1]: position (by 1.5), velocity (by 0.5); clearance from
    the outer square and from the obstacle's circle (by 1.5 and 2); 1 if the next step will report ``wall``;
    and for each target its offset from the car (by 2.25), its distance (by 3.2), and 1 if the next step will
    report it.

    Observation ``"raw"``, the authors' 9 numbers: x, y, vx, vy, the four target distances before the move (0
    at reset), and 1 if the step reported ``wall``.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - gymnasium's own convention

    def __init__(self, observation: Observation = "features", render_mode: str | None = None) -> None:
        """Make a car at the start.

        Args:
            observation: "features" or "raw".
            render_mode: None or "rgb_array".

        Raises:
            ValueError: if an argument is none of these.
        """
        checked_choice("render_mode", render_mode, (None, "rgb_array"))
        self.propositions: tuple[str, ...] = ("g1", "g2", "g3", "g4", "wall")
        self.observation_space = observation_space(observation)
        self.action_space = self._forces = symmetric_box(TOP_FORCE, 2)
        self.render_mode = render_mode
        self._observation = observation
        self._walls = Walls()
        self._state = _start_state()
        self._labels = self._due_labels()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Back to the start; the same for every seed. Options are ignored."""
        super().reset(seed=seed)
        self._state = _start_state()
        self._labels = self._due_labels()
        return self._observe(), {"labels": self._labels}

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Apply two forces, array of shape (2,).

        Raises:
            ValueError: if ``action`` has another shape or type, holds NaN or is not within +-1.
        """
        fx, fy = checked_box_actions(self._forces, TOP_FORCE, action, (2,)).tolist()
        # Quirk: labels are of the state before the move, so a wall that is hit shows in the next step's.
        self._labels = self._due_labels()
        self._move(fx, fy)
        return self._observe(), 0.0, False, False, {"labels": self._labels}

    def get_state(self) -> NDArray[np.float64]:
        """A snapshot: float64 array of shape (10,), see the module."""
        return np.array(self._state)

    def set_state(self, state: NDArray[Any]) -> NDArray[np.float32]:
        """Restore a snapshot; returns the observation there.

        Raises:
            ValueError: if ``state`` is no snapshot of a Racecar; nothing changes then.
        """
        self._state = _checked_state(state)
        self._labels = self._due_labels()
        return self._observe()

    def render(self) -> NDArray[np.uint8] | None:
        """The track and the labels, uint8 array of shape (536, 500, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        return _render_track(self._state, self.propositions, self._labels)

    def _due_labels(self) -> frozenset[str]:
        """What the next step reports, decided by the present state."""
        x, y = self._state[:2]
        due = [
            name
            for name, (tx, ty) in zip(self.propositions, TARGETS, strict=False)
            if math.hypot(x - tx, y - ty) <= TARGET_RADIUS
        ]
        return frozenset([*due, "wall"] if self._state[9] else due)

    def _move(self, fx: float, fy: float) -> None:
        x, y, vx, vy, *_, hit = self._state
        distances = [math.hypot(x - tx, y - ty) for tx, ty in TARGETS]
        new_x = x + (vx * DT + fx * _HALF_DT_SQUARED)
        new_y = y + (vy * DT + fy * _HALF_DT_SQUARED)
        if self._walls.met((x, y), (new_x, new_y)):
            self._state = [*START, 0.0, 0.0, *distances, hit, 1.0]
            return
        vx = min(max(vx + fx * DT, -TOP_SPEED), TOP_SPEED)
        vy = min(max(vy + fy * DT, -TOP_SPEED), TOP_SPEED)
        self._state = [new_x, new_y, vx, vy, *distances, hit, 0.0]

    def _observe(self) -> NDArray[np.float32]:
        if self._observation == "raw":
            return np.array(self._state[:9], dtype=np.float32)
        return np.array(_features(self._state), dtype=np.float32)


def observation_space(observation: Observation) -> spaces.Box:
    """The observation space.

    Raises:
        ValueError: if ``observation`` is neither "features" nor "raw".
    """
    checked_choice("observation", observation, ("features", "raw"))
    if observation == "features":
        return spaces.Box(-1.0, 1.0, (_FEATURES,), np.float32)
    low = [-OUTER, -OUTER, -TOP_SPEED, -TOP_SPEED, 0, 0, 0, 0, 0]
    high = [OUTER, OUTER, TOP_SPEED, TOP_SPEED, *[DISTANCE_BOUND] * len(TARGETS), 1]
    return spaces.Box(np.array(low, dtype=np.float32), np.array(high, dtype=np.float32))


def _start_state() -> list[float]:
    return [*START, *[0.0] * (STATE_SIZE - 2)]


def _features(state: list[float]) -> list[float]:
    x, y, vx, vy = state[:4]
    outer = (OUTER - max(abs(x), abs(y))) / OUTER
    inner = (math.hypot(x, y) - OBSTACLE_RADIUS) / 2
    numbers = [x / OUTER, y / OUTER, vx / TOP_SPEED, vy / TOP_SPEED, outer, inner, state[9]]
    for tx, ty in TARGETS:
        dx, dy = tx - x, ty - y
        distance = math.hypot(dx, dy)
        inside = float(distance <= TARGET_RADIUS)
        numbers += [dx / _FARTHEST_AXIS, dy / _FARTHEST_AXIS, distance / DISTANCE_BOUND, inside]
    return numbers


def _checked_state(snapshot: object) -> list[float]:
    rows = snapshot[None] if isinstance(snapshot, np.ndarray) else snapshot
    state: list[float] = checked_snapshots("Racecar", rows, 1, STATE_SIZE, "f")[0].tolist()
    x, y, vx, vy, *distances, reported, hit = state
    wrong = {
        f"its speed is not within +-{TOP_SPEED}": max(abs(vx), abs(vy)) > TOP_SPEED,
        f"a distance is not in 0..{DISTANCE_BOUND}": not all(0 <= d <= DISTANCE_BOUND for d in distances),
        "a wall flag is neither 0 nor 1": not {reported, hit} <= {0.0, 1.0},
        "its position is not on the track": not on_track(x, y),
    }
    for reason, holds in wrong.items():
        if holds:
            raise ValueError(f"no snapshot of Racecar: {reason}: {state}")
    return state


def _pixels(x: float, y: float) -> tuple[float, float]:
    """Where a place of the track is in the picture; y points up on the track."""
    return _HALF_WIDTH + x * _SCALE, _HALF_WIDTH - y * _SCALE


def _render_track(state: list[float], propositions: tuple[str, ...], labels: frozenset[str]) -> NDArray[np.uint8]:
    from envs.rendering import DARK, GREY, LABEL_BAND_HEIGHT, WHITE, Canvas

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
    """Discs with their names, paler while they are not reported."""
    from envs.rendering import DARK, GREEN

    for number, (x, y) in enumerate(TARGETS, start=1):
        fill = GREEN if f"g{number}" in labels else (188, 228, 214)
        canvas.disc(*_pixels(x, y), TARGET_RADIUS * _SCALE, fill=fill, outline=GREEN, width=2)
        canvas.text(*_pixels(x, y), f"g{number}", DARK, 18)


def _draw_car(canvas: Canvas, state: list[float]) -> None:
    """A disc with an arrow for its velocity: where it would be a time unit later."""
    from envs.rendering import BLUE, ORANGE, WHITE

    x, y, vx, vy = state[:4]
    canvas.line([_pixels(x, y), _pixels(x + vx, y + vy)], ORANGE, 3)
    canvas.disc(*_pixels(x, y), 7, fill=BLUE, outline=WHITE, width=2)
