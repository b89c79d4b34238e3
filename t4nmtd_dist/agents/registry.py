"""Put a learner together from a compiled task."""

from __future__ import annotations

import zlib

import numpy as np

from t4nmtd_dist.agents.common.rollout import Rollout
from t4nmtd_dist.agents.ppo.agent import PPOLearner
from t4nmtd_dist.agents.protocol import Learner
from t4nmtd_dist.core.devices import Device
from t4nmtd_dist.environments.action_spaces import action_bounds, action_count
from t4nmtd_dist.environments.timed import make_task_env
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.method.protocol import Method
from t4nmtd_dist.method.rewards import SymbolReader
from t4nmtd_dist.method.start_states import InitialStateBuffer


def subtask_seed(seed: int, pid: str, epoch: int) -> int:
    """A seed of its own for every sub-task and lease."""
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
    """A learner for sub-task ``pid`` in environments of its own, with its networks on ``device``.

    Raises:
        EnvError: if the environment cannot be opened, or its spaces or propositions do not fit.
        ConfigError: if the algorithm has not been decided (``environments.preparation.prepared`` does).
    """
    config = task.config
    settings, own = config.learner, config.agent
    env = make_task_env(config, own.num_envs)
    reader = SymbolReader(task.dfa, env.propositions)
    rollout = Rollout(env, reader, method, pid, buffer, np.random.default_rng([seed, 0]))
    normalised = ~env.categorical if settings.normalise_observations == "on" else None
    if settings.algorithm == "ppo":
        actions = action_count(env.action_space, config.environment.id, settings.algorithm.upper())
        states = task.dfa.states
        return PPOLearner(
            pid, rollout, settings, own, method,
            dfa_states=states, actions=actions, seed=seed, device=device, normalised=normalised,
        )  # fmt: skip
    bounds = action_bounds(env.action_space, config.environment.id, settings.algorithm.upper())
    from t4nmtd_dist.agents.sac.agent import SACLearner

    delta = task.dfa.delta
    return SACLearner(
        pid, rollout, delta, settings, own, method,
        bounds=bounds, seed=seed, peers=len(task.decomposition.pids) - 1, device=device, normalised=normalised,
    )  # fmt: skip
