"""HalfCheetah's model (tasks 3 and 4), markers and observations.

Physics, frame skip, reset noise and the model file are those of gymnasium's ``HalfCheetah-v5``; its rewards, force
sensors and viewer are omitted.
"""

from __future__ import annotations

import math
import warnings
from functools import cache
from pathlib import Path
from typing import Any, Literal

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from envs.checks import checked_choice

Observation = Literal["features", "raw"]

PROPOSITIONS = ("h1", "h2", "h3", "h4", "h5")
MARKERS = (-8.0, -4.0, 0.0, 4.0, 8.0)  # one per proposition
MARKER_REACH = 0.3
FRAME_SKIP = 5
TOP_TORQUE = 1.0
RESET_NOISE = 0.1

_MODEL_FILE = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "half_cheetah.xml"
JOINTS = 6
_POSITIONS = 3 + JOINTS  # x, z, pitch and the joints; as many velocities
X, _PITCH = 0, 2
_MARKER_SCALE = 4.0  # from one marker to the next
# Under extreme torques, joints reach 1.2 rad and 30 rad/s, the body 1 m, 10 m/s and 12 rad/s.
_SCALES = np.array([10.0, 1.0, 1.0, *[1.25] * JOINTS, 10.0, 6.0, 12.0, *[30.0] * JOINTS])
_MARKERS_BY_SCALE = np.array(MARKERS) / _MARKER_SCALE
_FEATURES = 2 * _POSITIONS + 1 + len(MARKERS)


@cache
def load_model() -> Any:
    """Gymnasium's half-cheetah as a ``mujoco.MjModel``, shared, since stepping only reads it."""
    # Compiled from a spec, because loading the file directly logs a MuJoCo 4 deprecation to the current folder.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return mujoco.MjSpec.from_file(str(_MODEL_FILE)).compile()


def observation_space(observation: Observation) -> spaces.Box:
    """The observation space; raw observations are unbounded.

    Raises:
        ValueError: if ``observation`` is neither "features" nor "raw".
    """
    checked_choice("observation", observation, ("features", "raw"))
    if observation == "features":
        return spaces.Box(-1.0, 1.0, (_FEATURES,), np.float32)
    return spaces.Box(-np.inf, np.inf, (2 * _POSITIONS,), np.float32)


def labels_at(x: float) -> frozenset[str]:
    """The markers near ``x``."""
    near = zip(PROPOSITIONS, MARKERS, strict=True)
    return frozenset([name for name, marker in near if abs(x - marker) < MARKER_REACH])


def observe(
    positions: NDArray[np.float64], velocities: NDArray[np.float64], observation: Observation
) -> NDArray[np.float32]:
    """The observation of qpos (9,) and qvel (9,), see ``envs.halfcheetah.HalfCheetahEnv``; a new array."""
    numbers = np.concatenate([positions, velocities])
    if observation == "raw":
        return numbers.astype(np.float32)
    x, pitch = positions.item(X), positions.item(_PITCH)
    numbers[_PITCH] = math.sin(pitch)
    numbers /= _SCALES
    features = np.concatenate([numbers, [math.cos(pitch)], _MARKERS_BY_SCALE - x / _MARKER_SCALE])
    np.minimum(features, 1, out=features)
    np.maximum(features, -1, out=features)
    return features.astype(np.float32)
