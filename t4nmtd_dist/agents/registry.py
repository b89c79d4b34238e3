"""Puts a learner together from a compiled task: environments, attempts, and the agent that the settings name."""

from __future__ import annotations

import zlib

import numpy as np

from t4nmtd_dist.agents.common.context import AgentContext
from t4nmtd_dist.agents.common.rollout import Attempts
from t4nmtd_dist.agents.modules import builder_module
from t4nmtd_dist.agents.protocol import Learner
from t4nmtd_dist.core.devices import Device
from t4nmtd_dist.environments.batched import BatchedEnv
from t4nmtd_dist.environments.timed import make_task_env
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.method.high_level import QTable
from t4nmtd_dist.method.rewards import ACCEPTANCE_REWARD, SubtaskTables, SymbolReader, subtask_tables
from t4nmtd_dist.method.start_states import InitialStateBuffer


def subtask_seed(seed: int, pid: str, epoch: int) -> int:
    """A seed of its own for every sub-task and lease."""
    sequence = np.random.SeedSequence([seed, zlib.crc32(pid.encode()), epoch])
    return int(sequence.generate_state(1)[0] >> 1)


def build_learner(
    task: CompiledTask,
    pid: str,
    buffer: InitialStateBuffer,
    high_level: QTable,
    *,
    seed: int,
    device: Device = "cpu",
) -> Learner:
    """A learner for sub-task ``pid`` in environments of its own, with its networks on ``device``.

    Raises:
        EnvError: if the environment cannot be opened, or its spaces or propositions do not fit.
        ConfigError: if there is no such algorithm, or it has not been decided (``environments.preparation.prepared``
            does).
    """
    config = task.config
    agent = builder_module(config.learner.algorithm)
    tables = _tables(task, pid)
    env = make_task_env(config, config.agent.num_envs)
    return agent.build(
        AgentContext(
            pid=pid,
            task=task,
            tables=tables,
            attempts=_attempts(task, tables, env, buffer, seed),
            action_space=env.action_space,
            high_level=high_level,
            seed=seed,
            device=device,
            normalised=~env.categorical & (config.learner.normalise_observations == "on"),
        )
    )


def _tables(task: CompiledTask, pid: str) -> SubtaskTables:
    settings = task.config.learner
    return subtask_tables(
        task.dfa,
        task.decomposition,
        pid,
        task.rho,
        gamma=settings.gamma,
        shaping=settings.shaping,
        error_penalty=_error_penalty(task),
    )


def _error_penalty(task: CompiledTask) -> float:
    """Where success comes at the end of the episode only, a late error must be better than an early one."""
    least = ACCEPTANCE_REWARD if task.config.acceptance == "end" else 0.0
    return max(task.config.learner.error_penalty, least)


def _attempt_steps(task: CompiledTask, tables: SubtaskTables) -> int:
    """An attempt at what is only reached at the end of an episode must be able to last until then."""
    steps = task.config.learner.attempt_steps
    waits_for_end = task.config.acceptance == "end" and not tables.target[:, ~tables.accepting].any()
    return max(steps, task.config.environment.horizon) if waits_for_end else steps


def _attempts(
    task: CompiledTask, tables: SubtaskTables, env: BatchedEnv, buffer: InitialStateBuffer, seed: int
) -> Attempts:
    settings = task.config.learner
    return Attempts(
        env,
        SymbolReader(task.dfa, env.propositions),
        tables,
        task.dfa.delta,
        buffer,
        reset_q=task.dfa.initial if tables.available[task.dfa.initial] else None,
        attempt_steps=_attempt_steps(task, tables),
        hand_over_all=settings.hand_over == "changes",
        rng=np.random.default_rng([seed, 0]),
    )
