"""Builds a learner from a compiled task: environments, rollout, and agent."""

from __future__ import annotations

import zlib

import numpy as np

from t4nmtd_dist.agents.common.context import AgentContext
from t4nmtd_dist.agents.common.rollout import AttemptRules, Rollout
from t4nmtd_dist.agents.modules import builder_module, off_policy_module
from t4nmtd_dist.agents.protocol import Learner
from t4nmtd_dist.agents.shared.episodes import Episodes
from t4nmtd_dist.agents.shared.learner import SharedLearner
from t4nmtd_dist.core.devices import Device
from t4nmtd_dist.environments.timed import make_task_env
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.method.protocol import Method
from t4nmtd_dist.method.rewards import SymbolReader
from t4nmtd_dist.method.start_states import InitialStateBuffer


def subtask_seed(seed: int, pid: str, epoch: int) -> int:
    """A separate seed for every sub-task and lease."""
    sequence = np.random.SeedSequence([seed, zlib.crc32(pid.encode()), epoch])
    return int(sequence.generate_state(1)[0] >> 1)


def build_learner(
    task: CompiledTask,
    pid: str,
    buffer: InitialStateBuffer,
    method: Method,
    *,
    seed: int,
    device: Device = "cpu",
) -> Learner:
    """Build the learner of sub-task ``pid`` with its own environments and its networks on ``device``.

    Raises:
        EnvError: if the environment cannot be opened, or its spaces or propositions do not fit.
        ConfigError: if the algorithm does not exist or is still ``"auto"`` (see ``environments.preparation.prepared``).
    """
    config = task.config
    env = make_task_env(config, config.agent.num_envs)
    reader = SymbolReader(task.dfa, env.propositions)
    rules: AttemptRules = Episodes(task, method) if method.shares_env else method
    context = AgentContext(
        pid=pid,
        task=task,
        rollout=Rollout(env, reader, rules, pid, buffer, np.random.default_rng([seed, 0])),
        action_space=env.action_space,
        method=method,
        seed=seed,
        device=device,
        normalised=~env.categorical & (config.learner.normalise_observations == "on"),
    )
    if method.shares_env:
        return SharedLearner(context, off_policy_module(config.learner.algorithm).algorithm)
    return builder_module(config.learner.algorithm).build(context)
