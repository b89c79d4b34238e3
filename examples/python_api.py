"""A task without a task file: walk to the left end of a corridor, then to the right one.

``python examples/python_api.py`` trains it in about twenty seconds. The code also works in a notebook.
"""

from __future__ import annotations

import sys
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist import Task, TrainingResult, train

END = 6


class Corridor(gymnasium.Env[NDArray[np.float32], np.int64]):
    """Thirteen cells in a row; actions 0 and 1 move left and right."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Start in the middle."""
        super().reset(seed=seed)
        self.place = 0
        return self._observation(), {}

    def step(self, action: np.int64) -> Any:
        """Move one cell, if there is one."""
        self.place = int(np.clip(self.place + (1 if action else -1), -END, END))
        return self._observation(), 0.0, False, False, {}

    def _observation(self) -> NDArray[np.float32]:
        return np.array([self.place / END], np.float32)


def labels(observation: NDArray[np.float32], info: dict[str, Any]) -> set[str]:
    """The end that is reached, if any."""
    return {name for name, end in (("left", -1), ("right", 1)) if observation[0] == end}


def main(run_dir: str | None = None) -> TrainingResult:
    """Train, then walk once with the policy."""
    settings = {"evaluation.every": 2000, "learner.attempt_steps": 40}
    task = Task("F(left & X(F(right)))", Corridor, labels=labels, horizon=60, name="corridor", settings=settings)
    result = train(task, run_dir=run_dir)
    print(result)
    env, policy, names = Corridor(), result.policy, set[str]()
    observation, _ = env.reset()
    places = [env.place]
    while not policy.accepts(names) and len(places) <= task.config.environment.horizon:
        observation, *_ = env.step(policy.act(observation, names))
        names = labels(observation, {})
        places.append(env.place)
    print("places:", *places)
    return result


if __name__ == "__main__":
    main(*sys.argv[1:2])
