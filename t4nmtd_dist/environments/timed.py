"""Environments of tasks whose trace ends with the episode: report ``last`` and the remaining time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.acceptance import LAST
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.environments.batched import BatchedEnv, EnvStep, Observations, Rows
from t4nmtd_dist.environments.make_env import make_env

_TIME = np.dtype("<i8")
_DTYPE_BYTES = 8  # field for a dtype name such as <f4
_HEADER_BYTES = _TIME.itemsize + _DTYPE_BYTES


def make_task_env(task: TaskConfig, count: int) -> BatchedEnv:
    """``count`` copies of a task's environment, with time if the task needs it.

    Raises:
        EnvError: see ``make_env``.
    """
    env = make_env(task.environment, count, task.propositions)
    return TimedEnv(env, task.environment.horizon) if task.acceptance == "end" else env


def ends_episode(steps: int, horizon: int, *, terminated: bool, truncated: bool) -> bool:
    """Whether ``last`` holds: at the horizon, or if the environment ends the episode."""
    return steps >= horizon or terminated or truncated


def remaining_share(steps: NDArray[np.int64] | int, horizon: int) -> NDArray[np.float32]:
    """Remaining share of the horizon after ``steps`` steps, from 1 down to 0."""
    share: NDArray[np.float32] = np.asarray(np.maximum(horizon - np.asarray(steps), 0) / horizon, np.float32)
    return share


def check_last_is_free(propositions: Sequence[str]) -> None:
    """Check that an environment does not use the proposition ``last``.

    Raises:
        EnvError: if it does.
    """
    if LAST in propositions:
        raise EnvError(f"the environment reports {LAST!r}, which is the end of the episode; give it another name")


class TimedEnv:
    """An environment that counts the steps of every episode.

    Observations gain the remaining share of the horizon. The proposition ``last`` is true on the last step of an
    episode: at the horizon, or when the environment terminates or truncates. Snapshots are uint8 arrays of the time,
    the dtype of the environment's own snapshot, and its bytes.

    Args:
        env: the environments.
        horizon: steps per episode.

    Raises:
        EnvError: if the environment reports a proposition ``last``.
    """

    def __init__(self, env: BatchedEnv, horizon: int) -> None:
        check_last_is_free(env.propositions)
        self._env, self._horizon = env, horizon
        self.count = env.count
        self.propositions: tuple[str, ...] = (*env.propositions, LAST)
        self.observation_size = env.observation_size + 1
        self.categorical = np.append(env.categorical, True)  # the time is already scaled: exclude it from normalisation
        self.action_space = env.action_space
        self._steps = np.zeros(env.count, np.int64)

    @property
    def replayed(self) -> int:
        """See ``BatchedEnv.replayed``."""
        return self._env.replayed

    def reset(self, rows: Rows, seed: int | None = None) -> Observations:
        """See ``BatchedEnv.reset``."""
        self._steps[rows] = 0
        return self._with_time(self._env.reset(rows, seed), rows)

    def restore(self, rows: Rows, states: Sequence[NDArray[Any]]) -> Observations:
        """See ``BatchedEnv.restore``."""
        parts = [_taken_apart(state) for state in states]
        observations = self._env.restore(rows, [state for _, state in parts])
        self._steps[rows] = [steps for steps, _ in parts]
        return self._with_time(observations, rows)

    def snapshot(self, rows: Rows) -> list[NDArray[Any]]:
        """See ``BatchedEnv.snapshot``."""
        states = self._env.snapshot(rows)
        return [_put_together(int(self._steps[row]), state) for row, state in zip(rows, states, strict=True)]

    def step(self, actions: NDArray[Any]) -> EnvStep:
        """See ``BatchedEnv.step``."""
        step = self._env.step(actions)
        self._steps += 1
        last = (self._steps >= self._horizon) | step.terminated | step.truncated
        observations = self._with_time(step.observations, np.arange(self.count))
        return EnvStep(observations, np.column_stack([step.labels, last]), step.terminated, step.truncated)

    def _with_time(self, observations: Observations, rows: Rows) -> Observations:
        seen: Observations = np.column_stack([observations, remaining_share(self._steps[rows], self._horizon)])
        return seen

    def state_dict(self) -> State:
        """See ``BatchedEnv.state_dict``."""
        return {"env": self._env.state_dict(), "steps": self._steps.copy()}

    def load_state_dict(self, state: State) -> None:
        """See ``BatchedEnv.load_state_dict``."""
        self._env.load_state_dict(state["env"])
        self._steps[:] = state["steps"]


def _put_together(steps: int, state: NDArray[Any]) -> NDArray[np.uint8]:
    header = np.array(steps, _TIME).tobytes() + state.dtype.str.encode().ljust(_DTYPE_BYTES)
    return np.frombuffer(header + state.tobytes(), np.uint8)


def _taken_apart(state: NDArray[Any]) -> tuple[int, NDArray[Any]]:
    """Steps and the environment's own snapshot.

    Raises:
        EnvError: if ``_put_together`` did not make the array.
    """
    if state.dtype != np.uint8 or state.ndim != 1 or len(state) < _HEADER_BYTES:
        raise EnvError(
            f"no snapshot with a time: expected uint8 [n], n >= {_HEADER_BYTES}, got {state.dtype} {state.shape}"
        )
    data = state.tobytes()
    steps = int(np.frombuffer(data[: _TIME.itemsize], _TIME)[0])
    try:
        own = np.frombuffer(data[_HEADER_BYTES:], np.dtype(data[_TIME.itemsize : _HEADER_BYTES].decode().strip()))
    except (TypeError, ValueError) as error:
        raise EnvError(f"no snapshot with a time: {error}") from None
    if steps < 0 or own.dtype.hasobject:
        raise EnvError(f"no snapshot with a time: {steps} steps of {own.dtype}")
    return steps, own
