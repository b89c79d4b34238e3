"""Rules of Waterworld (tasks 1 and 2) on arrays of states.

``envs.waterworld_ponds`` handles motion and touches.

The states of N copies are an array (4, N, balls + 1): planes x, y, vx, vy (numpy is fast along long axes) of the balls
in colour order, then of the agent. A snapshot is a flat float64 row: x, y, vx, vy of each ball, then of the agent, 76
numbers for 18 balls, 100 for 24. The field is 30 by 30; velocities are per step.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from envs.checks import checked_choice, checked_snapshots
from envs.waterworld_maps import BALLS_PER_COLOUR, SIDE, Palette

Observation = Literal["features", "raw"]
OBSERVATIONS = ("features", "raw")

RADIUS = 0.5  # of balls and agent
TOP_COMMAND = 3.5
AGENT = -1  # row
START = (SIDE / 2, SIDE / 2, 0.0, 0.0)

_AGENT_FEATURES = 6
_BALL_FEATURES = 7
TOUCH = 2 * RADIUS  # maximum offset per axis between the agent and a ball it touches
REACH = TOP_COMMAND + TOUCH  # maximum offset per axis of a ball that a command can touch
DISTANT = 1 / 8  # scale of all balls' features relative to those within reach: docs/decisions/018


def snapshot_size(palette: Palette) -> int:
    """Length of a snapshot, and of the raw observation."""
    return 4 * (palette.balls + 1)


def to_states(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """States (4, N, balls + 1) from snapshots (N, 4*(balls + 1)); a copy."""
    return np.ascontiguousarray(rows.reshape(len(rows), rows.shape[1] // 4, 4).transpose(2, 0, 1))


def to_snapshots(states: NDArray[np.float64]) -> NDArray[np.float64]:
    """Snapshots (N, 4*(balls + 1)) from states (4, N, balls + 1); a copy."""
    return np.ascontiguousarray(states.transpose(1, 2, 0)).reshape(states.shape[1], 4 * states.shape[2])


def reflect(states: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Clamp positions at the walls and reverse the velocity there, per axis, in place.

    Returns:
        The reversed axes, x and y, of states (4, ...): bool (2, ...).
    """
    positions, velocities = states[:2], states[2:]
    turned: NDArray[np.bool_] = (positions <= 0) | (positions >= SIDE)
    velocities[:] = np.where(turned, -velocities, velocities)
    np.minimum(positions, SIDE, out=positions)
    np.maximum(positions, 0, out=positions)
    return turned


def finish_move(states: NDArray[np.float64], commands: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Complete a step after everything has moved by its velocity, in place.

    Quirk: the command becomes the velocity of the *next* step. On an axis where the agent reached a wall, it is ignored
    and the reversed velocity kept.

    Args:
        states: shape (4, N, balls + 1).
        commands: shape (N, 2), within +-3.5.

    Returns:
        bool (N, balls + 1): bodies that reached a wall.
    """
    turned = reflect(states)
    agent = states[2:, :, AGENT]
    agent[:] = np.where(turned[:, :, AGENT], agent, commands.T)
    at_wall: NDArray[np.bool_] = turned[0] | turned[1]
    return at_wall


def observation_space(palette: Palette, observation: Observation) -> spaces.Box:
    """The observation space of one Waterworld.

    Raises:
        ValueError: if ``observation`` is neither "features" nor "raw".
    """
    checked_choice("observation", observation, OBSERVATIONS)
    if observation == "features":
        colours = len(palette.colours)
        size = _AGENT_FEATURES + 2 * colours + palette.balls * _BALL_FEATURES
        return spaces.Box(-1.0, 1.0, (size,), np.float32)
    speed = np.full((palette.balls + 1, 2), palette.top_speed, dtype=np.float32)
    speed[AGENT] = TOP_COMMAND
    low = np.concatenate([np.zeros_like(speed), -speed], axis=1)
    high = np.concatenate([np.full_like(speed, SIDE), speed], axis=1)
    return spaces.Box(low.ravel(), high.ravel())


def observe(palette: Palette, states: NDArray[np.float64], observation: Observation) -> NDArray[np.float32]:
    """Observations of states (4, N, balls + 1), see ``envs.waterworld.WaterworldEnv``; a new array (N, d)."""
    if observation == "raw":
        return to_snapshots(states).astype(np.float32)
    return _features(palette, states)


def _features(palette: Palette, states: NDArray[np.float64]) -> NDArray[np.float32]:
    count, colours, balls = states.shape[1], len(palette.colours), palette.balls
    # Balls ignore the agent, so their future is certain: "soon" is after the coming step, "later" after the next one,
    # in which the command given now moves the agent.
    soon = states.copy()
    soon[:2] += soon[2:]
    ignored = reflect(soon)[:, :, AGENT:]
    agent_later = soon[:2, :, AGENT:] + np.where(ignored, soon[2:, :, AGENT:], 0)  # without an effective command
    later = np.clip(soon[:2, :, :AGENT] + soon[2:, :, :AGENT], 0, SIDE)
    by_ball = np.empty((_BALL_FEATURES, count, balls))
    within = by_ball[0]
    lead = np.subtract(later, agent_later, out=by_ball[1:3])
    offsets = np.subtract(states[:2, :, :AGENT], states[:2, :, AGENT:], out=by_ball[3:5])
    order = _nearest_first(lead)
    out = np.empty((count, _AGENT_FEATURES + 2 * colours + balls * _BALL_FEATURES), np.float32)
    out[:, 0:2] = states[:2, :, AGENT].T / (SIDE / 2) - 1
    out[:, 2:4] = states[2:, :, AGENT].T / TOP_COMMAND
    out[:, 4:6] = ignored[..., 0].T
    out[:, 6 : 6 + colours] = _touched(offsets, colours)
    soon_offsets = soon[:2, :, :AGENT] - soon[:2, :, AGENT:]
    out[:, 6 + colours : 6 + 2 * colours] = _touched(soon_offsets, colours)
    within[:] = (np.abs(lead) <= np.where(ignored, TOUCH, REACH)).all(axis=0)
    lead *= np.where(ignored, 0, within / REACH)
    offsets *= DISTANT / SIDE
    np.multiply(states[2:, :, :AGENT], DISTANT / palette.top_speed, out=by_ball[5:7])
    by_row = by_ball.reshape(_BALL_FEATURES, -1).take(order, axis=1).reshape(_BALL_FEATURES, count, balls)
    out[:, 6 + 2 * colours :].reshape(count, balls, _BALL_FEATURES)[:] = by_row.transpose(1, 2, 0)
    return out


def _reach(offsets: NDArray[np.float64]) -> NDArray[np.float64]:
    """The larger absolute coordinate of ``offsets`` (2, N, balls): (N, balls)."""
    reach: NDArray[np.float64] = np.maximum(np.abs(offsets[0]), np.abs(offsets[1]))
    return reach


def _nearest_first(offsets: NDArray[np.float64]) -> NDArray[np.intp]:
    """Flat indices (N*balls,), nearest ball of each colour first, ties in map order."""
    order = np.argsort(_reach(offsets).reshape(-1, BALLS_PER_COLOUR), axis=1, kind="stable")
    return (order + BALLS_PER_COLOUR * np.arange(len(order))[:, None]).ravel()


def _touched(offsets: NDArray[np.float64], colours: int) -> NDArray[np.bool_]:
    """Colours that touch the agent at ``offsets`` (2, N, balls): bool (N, colours)."""
    near = (_reach(offsets) <= TOUCH).reshape(-1, colours, BALLS_PER_COLOUR)
    touched: NDArray[np.bool_] = near[..., 0] | near[..., 1] | near[..., 2]
    return touched


def checked_states(palette: Palette, snapshots: object, count: int) -> NDArray[np.float64]:
    """Validate snapshots and copy them to states, float64 (4, count, balls + 1).

    Raises:
        ValueError: if they are not finite floats of shape (count, 4*(balls + 1)), or one has a position outside the
            field or an impossible velocity.
    """
    env = f"Waterworld with {palette.balls} balls"
    flat = checked_snapshots(env, snapshots, count, snapshot_size(palette), "f")
    states = to_states(flat.astype(np.float64))
    positions, speeds = states[:2], np.abs(states[2:])
    wrong = {
        f"a position is not in 0..{SIDE}": (positions < 0) | (positions > SIDE),
        f"a ball is faster than {palette.top_speed}": speeds[:, :, :AGENT] > palette.top_speed,
        f"its agent is faster than {TOP_COMMAND}": speeds[:, :, AGENT:] > TOP_COMMAND,
    }
    for reason, entries in wrong.items():
        if entries.any():
            row = int(np.argmax(entries.any(axis=(0, 2))))
            raise ValueError(f"row {row} is no snapshot of {env}: {reason}: {flat[row]}")
    return states
