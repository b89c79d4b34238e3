"""A tiny learner of every registered agent: of task 7 for discrete actions, of task 5 for continuous ones."""

from __future__ import annotations

from dataclasses import fields
from functools import cache

import torch

from t4nmtd_dist.agents.common.peer_values import NoPeers
from t4nmtd_dist.agents.protocol import Learner
from t4nmtd_dist.agents.registry import build_learner
from t4nmtd_dist.core.agent_settings import agent_settings
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.method.start_states import InitialStateBuffer
from t4nmtd_dist.tasks import load_task

torch.set_num_threads(1)

TASKS = {"discrete": "task7", "continuous": "task5"}
TINY = {
    "num_envs": 2,
    "rollout": 16,
    "epochs": 2,
    "minibatch": 32,
    "batch": 16,
    "learning_starts": 50,
    "replay_rows": 400,
    "updates_per_step": 1,
}


@cache
def small_agent_task(algorithm: str) -> CompiledTask:
    """A task compiled with a tiny learner; settings that the agent does not have are left out."""
    settings = agent_settings(algorithm)
    known = {field.name for field in fields(settings.config)}
    own = [f"{algorithm}.{key}={value}" for key, value in TINY.items() if key in known]
    flags = [f"learner.algorithm={algorithm}", "learner.hidden=[16]", *own]
    return compile_task(load_task(TASKS[settings.actions], flags=flags))


def small_agent(algorithm: str, iterations: int = 0) -> Learner:
    """A learner of the first sub-task that begins at the reset, after some iterations without peers."""
    task = small_agent_task(algorithm)
    for pid in task.decomposition.pids:
        learner = build_learner(task, pid, InitialStateBuffer(100), task.method(), seed=0)
        if learner.rollout.begin():
            break
    for _ in range(iterations):
        assert learner.iterate(NoPeers())
    return learner
