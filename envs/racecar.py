"""Racecar (tasks 5 and 6): a point mass with two thrusters on a walled square, from the IPPC 2023 domain."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from envs.action_checks import checked_box_actions, symmetric_box
from envs.checks import checked_choice
from envs.racecar_rules import (
    DT,
    HALF_DT_SQUARED,
    PROPOSITIONS,
    TOP_FORCE,
    TOP_SPEED,
    Observation,
    checked_state,
    due_labels,
    features,
    observation_space,
    start_state,
)
from envs.racecar_track import START, TARGETS, Walls


class RacecarEnv(gymnasium.Env[NDArray[Any], Any]):
    """One car; id ``t4nmtd/Racecar-v0``, contract in ``envs.protocol.SnapshotEnv``.

    Action: forces in [-1, 1]^2 on a mass of 1 for 0.1 time units, without friction; speed is clipped to 0.5 per axis.
    Hitting a wall (outer square or central obstacle) returns the car to the start, at rest.

    Labels: ``g1`` to ``g4`` if the car was in that target *before* the step's move; ``wall`` if the previous step hit a
    wall. At reset none. The environment never terminates.

    Observation ``"features"``, 23 numbers in [-1, 1]: position (by 1.5), velocity (by 0.5); clearance from the outer
    square and the obstacle's circle (by 1.5 and 2); 1 if the next step will report ``wall``; per target its offset from
    the car (by 2.25), its distance (by 3.2), and 1 if the next step will report it.

    Observation ``"raw"``, the authors' 9 numbers: x, y, vx, vy, the four target distances before the move (0 at reset),
    and 1 if the step reported ``wall``.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - gymnasium's own convention

    def __init__(self, observation: Observation = "features", render_mode: str | None = None) -> None:
        """Make a car at the start.

        Args:
            observation: "features" or "raw".
            render_mode: None or "rgb_array".

        Raises:
            ValueError: if an argument is invalid.
        """
        checked_choice("render_mode", render_mode, (None, "rgb_array"))
        self.propositions: tuple[str, ...] = PROPOSITIONS
        self.observation_space = observation_space(observation)
        self.action_space = self._forces = symmetric_box(TOP_FORCE, 2)
        self.render_mode = render_mode
        self._observation = observation
        self._walls = Walls()
        self._state = start_state()
        self._labels = due_labels(self._state)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Reset to the start, independently of the seed. Options are ignored."""
        super().reset(seed=seed)
        self._state = start_state()
        self._labels = due_labels(self._state)
        return self._observe(), {"labels": self._labels}

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Apply two forces, shape (2,).

        Raises:
            ValueError: if ``action`` has the wrong shape or type, is NaN or not within +-1.
        """
        fx, fy = checked_box_actions(self._forces, TOP_FORCE, action, (2,)).tolist()
        # Quirk: labels describe the state before the move, so the next step reports a wall hit.
        self._labels = due_labels(self._state)
        self._move(fx, fy)
        return self._observe(), 0.0, False, False, {"labels": self._labels}

    def get_state(self) -> NDArray[np.float64]:
        """A snapshot: float64 (10,), see ``envs.racecar_rules``."""
        return np.array(self._state)

    def set_state(self, state: NDArray[Any]) -> NDArray[np.float32]:
        """Restore a snapshot; returns its observation.

        Raises:
            ValueError: if ``state`` is not a snapshot of Racecar; the environment is then unchanged.
        """
        self._state = checked_state(state)
        self._labels = due_labels(self._state)
        return self._observe()

    def render(self) -> NDArray[np.uint8] | None:
        """The track and the labels, uint8 (536, 500, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        from envs.racecar_drawing import render_track

        return render_track(self._state, self.propositions, self._labels)

    def _move(self, fx: float, fy: float) -> None:
        x, y, vx, vy, *_, hit = self._state
        distances = [math.hypot(x - tx, y - ty) for tx, ty in TARGETS]
        new_x = x + (vx * DT + fx * HALF_DT_SQUARED)
        new_y = y + (vy * DT + fy * HALF_DT_SQUARED)
        if self._walls.met((x, y), (new_x, new_y)):
            self._state = [*START, 0.0, 0.0, *distances, hit, 1.0]
            return
        vx = min(max(vx + fx * DT, -TOP_SPEED), TOP_SPEED)
        vy = min(max(vy + fy * DT, -TOP_SPEED), TOP_SPEED)
        self._state = [new_x, new_y, vx, vy, *distances, hit, 0.0]

    def _observe(self) -> NDArray[np.float32]:
        if self._observation == "raw":
            return np.array(self._state[:9], dtype=np.float32)
        return np.array(features(self._state), dtype=np.float32)
