"""HalfCheetah (tasks 3 and 4): gymnasium's half-cheetah on MuJoCo, with five markers on the ground.

A snapshot is MuJoCo's integration state: time, positions, velocities, controls, applied forces and the solver's warm
start, without which the next step differs in its last bits.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.action_checks import checked_box_actions, symmetric_box
from envs.checks import checked_choice, checked_snapshots
from envs.halfcheetah_rules import (
    FRAME_SKIP,
    JOINTS,
    PROPOSITIONS,
    RESET_NOISE,
    TOP_TORQUE,
    Observation,
    X,
    labels_at,
    load_model,
    observation_space,
    observe,
)

_INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION


class HalfCheetahEnv(gymnasium.Env[NDArray[Any], Any]):
    """One cheetah; id ``t4nmtd/HalfCheetah-v0``, contract in ``envs.protocol.SnapshotEnv``.

    Action: six torques in [-1, 1], of the back thigh, shin and foot and the front ones, for 0.05 s.

    Labels: ``h1`` to ``h5`` if x is closer than 0.3 to -8, -4, 0, 4, 8 *after* the step. The environment never
    terminates.

    Observation ``"features"``, 24 numbers clipped to [-1, 1]: x (by 10), z, sine of the pitch, six joint angles (by
    1.25); nine velocities (by 10 m/s, 6 m/s, 12 rad/s, and 30 rad/s for joints); cosine of the pitch; and the offset to
    each marker (by 4, their distance).

    Observation ``"raw"``, the authors' 18 numbers: nine positions including x, nine velocities.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 - gymnasium's own convention

    def __init__(self, observation: Observation = "features", render_mode: str | None = None) -> None:
        """Make a cheetah.

        Args:
            observation: "features" or "raw".
            render_mode: None or "rgb_array".

        Raises:
            ValueError: if an argument is invalid.
        """
        checked_choice("render_mode", render_mode, (None, "rgb_array"))
        self.propositions: tuple[str, ...] = PROPOSITIONS
        self.observation_space = observation_space(observation)
        self.action_space = self._torques = symmetric_box(TOP_TORQUE, JOINTS)
        self.render_mode = render_mode
        self._observation = observation
        self._model = load_model()
        self._data = mujoco.MjData(self._model)
        self._positions, self._velocities = self._data.qpos, self._data.qvel  # views that follow the simulation
        self._snapshot_size = int(mujoco.mj_stateSize(self._model, _INTEGRATION))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Reset near x = 0 with the noise of gymnasium's ``HalfCheetah-v5``; ignores ``options``.

        The noise is uniform 0.1 on positions, normal 0.1 on velocities.
        """
        super().reset(seed=seed)
        mujoco.mj_resetData(self._model, self._data)
        self._positions += self.np_random.uniform(-RESET_NOISE, RESET_NOISE, self._model.nq)
        self._velocities += RESET_NOISE * self.np_random.standard_normal(self._model.nv)
        mujoco.mj_forward(self._model, self._data)
        return self._observe(), {"labels": labels_at(self._positions.item(X))}

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Apply six torques, shape (6,).

        Raises:
            ValueError: if ``action`` has the wrong shape or type, is NaN or not within +-1.
        """
        self._data.ctrl[:] = checked_box_actions(self._torques, TOP_TORQUE, action, (JOINTS,))
        mujoco.mj_step(self._model, self._data, nstep=FRAME_SKIP)
        return self._observe(), 0.0, False, False, {"labels": labels_at(self._positions.item(X))}

    def get_state(self) -> NDArray[np.float64]:
        """A snapshot: float64 array of MuJoCo's integration state, 91 numbers in MuJoCo 3 and 4."""
        snapshot = np.empty(self._snapshot_size)
        mujoco.mj_getState(self._model, self._data, snapshot, _INTEGRATION)
        return snapshot

    def set_state(self, state: NDArray[Any]) -> NDArray[np.float32]:
        """Restore a snapshot; returns its observation.

        Raises:
            ValueError: if ``state`` is not a snapshot of HalfCheetah; the environment is then unchanged.
        """
        rows = state[None] if isinstance(state, np.ndarray) else state
        restored = checked_snapshots("HalfCheetah", rows, 1, self._snapshot_size, "f")[0].astype(np.float64)
        mujoco.mj_setState(self._model, self._data, restored, _INTEGRATION)
        return self._observe()

    def render(self) -> NDArray[np.uint8] | None:
        """Side view of the cheetah and the labels, uint8 array (356, 640, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        from envs.halfcheetah_drawing import render_side_view

        return render_side_view(self._model, self._positions, self.propositions, labels_at(self._positions.item(X)))

    def _observe(self) -> NDArray[np.float32]:
        return observe(self._positions, self._velocities, self._observation)
