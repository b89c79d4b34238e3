"""Task 7 with tiny networks and roll-outs, compiled once per test process, and ways through its lake."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from t4nmtd_dist.agents.ppo.agent import PPOLearner
from t4nmtd_dist.agents.registry import build_learner
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.environments.make_env import make_env
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.method.start_states import InitialStateBuffer
from t4nmtd_dist.tasks import load_task

torch.set_num_threads(1)

TINY = ("ppo.num_envs=4", "ppo.rollout=16", "ppo.epochs=2", "ppo.minibatch=32", "learner.hidden=[16]")

PLAIN = ("learner.hand_over=targets",)  # Algorithm 2 as it stands: only states in which a target was reached are kept

LEFT, DOWN, RIGHT, UP, PICK, DROP = range(6)
TO_PASSENGER_2 = (RIGHT, RIGHT, RIGHT, DOWN, DOWN, DOWN)
TO_GOAL = (DOWN, DOWN, RIGHT, RIGHT)  # from passenger 2
INTO_HOLE = (DOWN, DOWN)  # from the start
START, CARRYING_2, ERROR, ACCEPTING = 0, 2, 3, 5  # states of the task's automaton


@cache
def small_config(*flags: str) -> TaskConfig:
    """Settings of task 7 with tiny learners; further ``key=value`` flags on top."""
    return load_task("task7", flags=[*TINY, *flags])


@cache
def small_task(*flags: str) -> CompiledTask:
    """Task 7 compiled with the settings of ``small_config``."""
    return compile_task(small_config(*flags))


def snapshot_after(*actions: int) -> NDArray[np.generic]:
    """The lake after some actions from its start."""
    env = make_env(small_config().environment, 1)
    env.reset(np.array([0]), 0)
    for action in actions:
        env.step(np.array([action]))
    return env.snapshot(np.array([0]))[0]


def small_learner(pid: str, *flags: str, starts: tuple[tuple[int, NDArray[np.generic]], ...] = ()) -> PPOLearner:
    """A learner of task 7 whose buffer holds ``starts`` as (DFA state, snapshot)."""
    task, buffer = small_task(*PLAIN, *flags), InitialStateBuffer(100)
    for q, state in starts:
        buffer.add(q, state)
    return build_learner(task, pid, buffer, task.method(), seed=0)


def own_task(folder: Path, text: str) -> Path:
    """A task file of one's own in ``folder``."""
    path = folder / "own.toml"
    path.write_text(text, encoding="utf-8")
    return path
