"""Racecar's states (tasks 5 and 6): validation, labels and observations.

A state, and so a snapshot, is 10 float64: x, y, vx, vy; the four target distances and the wall flag reported by the
last step; and 1 if that step hit a wall, so that the next one reports it.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from gymnasium import spaces

from envs.checks import checked_choice, checked_snapshots
from envs.racecar_track import (
    DISTANCE_BOUND,
    OBSTACLE_RADIUS,
    OUTER,
    START,
    TARGET_RADIUS,
    TARGETS,
    on_track,
)

Observation = Literal["features", "raw"]
PROPOSITIONS = ("g1", "g2", "g3", "g4", "wall")

TOP_FORCE = 1.0
TOP_SPEED = 0.5
DT = 0.1
STATE_SIZE = 10
HALF_DT_SQUARED = DT**2 / 2
_FARTHEST_AXIS = OUTER + max(abs(x) for x, _ in TARGETS)  # from a target, along one axis
_FEATURES = 4 + 2 + 1 + len(TARGETS) * 4


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


def start_state() -> list[float]:
    """At the start, at rest, with nothing to report."""
    return [*START, *[0.0] * (STATE_SIZE - 2)]


def due_labels(state: list[float]) -> frozenset[str]:
    """Labels of the next step, determined by the current state."""
    x, y = state[:2]
    due = [
        name
        for name, (tx, ty) in zip(PROPOSITIONS, TARGETS, strict=False)
        if math.hypot(x - tx, y - ty) <= TARGET_RADIUS
    ]
    return frozenset([*due, "wall"] if state[9] else due)


def features(state: list[float]) -> list[float]:
    """The 23 features described in ``envs.racecar.RacecarEnv``."""
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


def checked_state(snapshot: object) -> list[float]:
    """Validate a snapshot as a state.

    Raises:
        ValueError: if it is invalid.
    """
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
