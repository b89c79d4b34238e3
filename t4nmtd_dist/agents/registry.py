"""Put a learner together from a compiled task."""

from __future__ import annotations

import zlib

import numpy as np

from t4nmtd_dist.agents.common.rollout import Attempts
from t4nmtd_dist.agents.ppo.agent import PPOLearner
from t4nmtd_dist.agents.protocol import Learner
from t4nmtd_dist.core.devices import Device
from t4nmtd_dist.environments.action_spaces import action_bounds, action_count
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
        ConfigError: if the algorithm has not been decided (``environments.preparation.prepared`` does).
    """
    config = task.config
    settings, own = config.learner, config.agent
    tables = subtask_tables(
        task.dfa,
        task.decomposition,
        pid,
        task.rho,
        gamma=settings.gamma,
        shaping=settings.shaping,
        error_penalty=_error_penalty(task),
    )
    env = make_task_env(config, own.num_envs)
    attempts = _attempts(task, tables, env, buffer, seed)
    normalised = ~env.categorical if settings.normalise_observations == "on" else None
    if settings.algorithm == "ppo":
        actions = action_count(env.action_space, config.environment.id, settings.algorithm.upper())
        states = task.dfa.states
        return PPOLearner(
            pid, attempts, settings, own, high_level,
            dfa_states=states, actions=actions, seed=seed, device=device, normalised=normalised,
        )  # fmt: skip
    bounds = action_bounds(env.action_space, config.environment.id, settings.algorithm.upper())
    from t4nmtd_dist.agents.sac.agent import SACLearner

    delta = task.dfa.delta
    return SACLearner(
        pid, attempts, tables, delta, settings, own, high_level,
        bounds=bounds, seed=seed, peers=len(task.decomposition.pids) - 1, device=device, normalised=normalised,
    )  # fmt: skip


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
