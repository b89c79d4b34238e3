"""Tiny runs and learners of methods whose roles share an environment, in tasks 7 and 5."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch

from coordinator.run_settings import RunSettings
from t4nmtd_dist.agents.common.peer_values import NoPeers
from t4nmtd_dist.agents.registry import build_learner
from t4nmtd_dist.agents.shared.learner import SharedLearner
from t4nmtd_dist.core.registry import METHODS
from t4nmtd_dist.launch.serial import SerialRun
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.method.start_states import InitialStateBuffer
from t4nmtd_dist.tasks import load_task

torch.set_num_threads(1)

SHARED = [name for name in METHODS.names() if hasattr(METHODS.module(name), "SHARES_ENV")]
OPTIONS = ["hdqn", "hrm"]

AGENT = {
    "num_envs": 2,
    "batch": 16,
    "learning_starts": 50,
    "replay_rows": 400,
    "updates_per_step": 0.5,
}
SHORT = ("learner.hidden=[16]", "environment.horizon=30", "learner.attempt_steps=12", "evaluation.episodes=2")


@cache
def shared_task(method: str, *flags: str, name: str = "task7") -> CompiledTask:
    """Task 7 (DQN) or 5 (SAC) with tiny networks and a small buffer that fills up soon."""
    agent = load_task(name, method=method).learner.algorithm
    own = [f"{agent}.{key}={value}" for key, value in AGENT.items()]
    return compile_task(load_task(name, method=method, flags=[*SHORT, *own, "evaluation.every=200", *flags]))


def shared_learner(method: str, *flags: str, name: str = "task7", iterations: int = 0) -> SharedLearner:
    """The one learner of a method, after some iterations."""
    task = shared_task(method, *flags, name=name)
    (pid,) = task.decomposition.pids
    learner = build_learner(task, pid, InitialStateBuffer(1), task.method(), seed=0)
    assert isinstance(learner, SharedLearner)
    for _ in range(iterations):
        assert learner.iterate(NoPeers())
    return learner


def shared_run(method: str, *flags: str, name: str = "task7", budget: int = 10**6) -> SerialRun:
    """A run in this process."""
    return SerialRun(shared_task(method, *flags, name=name), RunSettings(0, budget, lease_s=np.inf), lambda: 0.0)
