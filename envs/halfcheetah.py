"""HalfCheetah (tasks 3 and 4): gymnasium's half-cheetah on MuJoCo, with five markers along the ground.

Physics, frame skip and reset noise are those of gymnasium's ``HalfCheetah-v5``, whose model file is used;
what that class does besides (rewards, a viewer, force sensors) is left out.

A snapshot is MuJoCo's integration state: time, positions, velocities, controls, applied forces and the
solver's warm start, without which the next step differs in its last bits.
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

from envs.box_actions import checked_box_actions, symmetric_box
from envs.protocol import checked_choice, checked_snapshots

Observation = Literal["features", "raw"]

MARKERS = (-8.0, -4.0, 0.0, 4.0, 8.0)  # h1 to h5
MARKER_REACH = 0.3
FRAME_SKIP = 5
TOP_TORQUE = 1.0
RESET_NOISE = 0.1

_MODEL_FILE = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "half_cheetah.xml"
_INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION
_JOINTS = 6
_POSITIONS = 3 + _JOINTS  # x, z, pitch and the joints; as many velocities
_X, _PITCH = 0, 2
_MARKER_SCALE = 4.0  # from one marker to the next
# Joints reach 1.2 and 30 rad/s under the wildest torques, the body 1 m, 10 m/s and 12 rad/s.
_SCALES = np.array([10.0, 1.0, 1.0, *[1.25] * _JOINTS, 10.0, 6.0, 12.0, *[30.0] * _JOINTS])
_MARKERS_BY_SCALE = np.array(MARKERS) / _MARKER_SCALE
_FEATURES = 2 * _POSITIONS + 1 + len(MARKERS)


class HalfCheetahEnv(gymnasium.Env[NDArray[Any], Any]):
    """One cheetah; id ``t4nmtd/HalfCheetah-v0``, contract in ``envs.protocol.SnapshotEnv``.

    Action: six torques in [-1, 1], of the back thigh, shin and foot and the front ones, for 0.05 s.

    Labels: ``h1`` to ``h5`` if x is closer than 0.3 to -8, -4, 0, 4, 8 *after* the step. An environment never
    terminates, however the cheetah lies.

    Observation ``"features"``, 24 numbers clipped to [-1, 1]: x (by 10), z, sine of the pitch (which grows with
    every somersault), six joint angles (by 1.25); nine velocities (by 10 m/s, 6 m/s, 12 rad/s, and 30 rad/s for
    joints); cosine of the pitch; and the offset to each marker (by 4, their distance, so that the next ones to
    either side are seen finely).

    Observation ``"raw"``, the authors' 18 numbers: nine positions including x, nine velocities.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 - gymnasium's own convention

    def __init__(self, observation: Observation = "features", render_mode: str | None = None) -> None:
        """Make a cheetah.

        Args:
            observation: "features" or "raw".
            render_mode: None or "rgb_array".

        Raises:
            ValueError: if an argument is none of these.
        """
        checked_choice("render_mode", render_mode, (None, "rgb_array"))
        self.propositions: tuple[str, ...] = ("h1", "h2", "h3", "h4", "h5")
        self.observation_space = observation_space(observation)
        self.action_space = self._torques = symmetric_box(TOP_TORQUE, _JOINTS)
        self.render_mode = render_mode
        self._observation = observation
        self._model = load_model()
        self._data = mujoco.MjData(self._model)
        self._positions, self._velocities = self._data.qpos, self._data.qvel  # views that follow the simulation
        self._snapshot_size = int(mujoco.mj_stateSize(self._model, _INTEGRATION))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Near x = 0, with gymnasium's noise: uniform 0.1 on positions, normal 0.1 on velocities.

        Args:
            seed: decides the noise, as in gymnasium's ``HalfCheetah-v5``.
            options: ignored.
        """
        super().reset(seed=seed)
        mujoco.mj_resetData(self._model, self._data)
        self._positions += self.np_random.uniform(-RESET_NOISE, RESET_NOISE, self._model.nq)
        self._velocities += RESET_NOISE * self.np_random.standard_normal(self._model.nv)
        mujoco.mj_forward(self._model, self._data)
        return self._observe(), {"labels": self._labels()}

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Apply six torques, array of shape (6,).

        Raises:
            ValueError: if ``action`` has another shape or type, holds NaN or is not within +-1.
        """
        self._data.ctrl[:] = checked_box_actions(self._torques, TOP_TORQUE, action, (_JOINTS,))
        mujoco.mj_step(self._model, self._data, nstep=FRAME_SKIP)
        return self._observe(), 0.0, False, False, {"labels": self._labels()}

    def get_state(self) -> NDArray[np.float64]:
        """A snapshot: float64 array of MuJoCo's integration state, 91 numbers in MuJoCo 3 and 4."""
        snapshot = np.empty(self._snapshot_size)
        mujoco.mj_getState(self._model, self._data, snapshot, _INTEGRATION)
        return snapshot

    def set_state(self, state: NDArray[Any]) -> NDArray[np.float32]:
        """Restore a snapshot; returns the observation there.

        Raises:
            ValueError: if ``state`` is no snapshot of a HalfCheetah; nothing changes then.
        """
        rows = state[None] if isinstance(state, np.ndarray) else state
        restored = checked_snapshots("HalfCheetah", rows, 1, self._snapshot_size, "f")[0].astype(np.float64)
        mujoco.mj_setState(self._model, self._data, restored, _INTEGRATION)
        return self._observe()

    def render(self) -> NDArray[np.uint8] | None:
        """The cheetah from the side and the labels, uint8 array (356, 640, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        from envs.halfcheetah_drawing import render_side_view

        return render_side_view(self._model, self._positions, self.propositions, self._labels())

    def _labels(self) -> frozenset[str]:
        x = self._positions.item(_X)
        near = zip(self.propositions, MARKERS, strict=True)
        return frozenset([name for name, marker in near if abs(x - marker) < MARKER_REACH])

    def _observe(self) -> NDArray[np.float32]:
        numbers = np.concatenate([self._positions, self._velocities])
        if self._observation == "raw":
            return numbers.astype(np.float32)
        x, pitch = self._positions.item(_X), self._positions.item(_PITCH)
        numbers[_PITCH] = math.sin(pitch)
        numbers /= _SCALES
        features = np.concatenate([numbers, [math.cos(pitch)], _MARKERS_BY_SCALE - x / _MARKER_SCALE])
        np.minimum(features, 1, out=features)
        np.maximum(features, -1, out=features)
        return features.astype(np.float32)


@cache
def load_model() -> Any:
    """Gymnasium's half-cheetah as a ``mujoco.MjModel``, shared by all environments since stepping only reads it."""
    # Compiled from a specification, because loading the file directly logs a deprecation of MuJoCo 4 into the
    # current folder.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return mujoco.MjSpec.from_file(str(_MODEL_FILE)).compile()


def observation_space(observation: Observation) -> spaces.Box:
    """The observation space; raw numbers have no bounds.

    Raises:
        ValueError: if ``observation`` is neither "features" nor "raw".
    """
    checked_choice("observation", observation, ("features", "raw"))
    if observation == "features":
        return spaces.Box(-1.0, 1.0, (_FEATURES,), np.float32)
    return spaces.Box(-np.inf, np.inf, (2 * _POSITIONS,), np.float32)
