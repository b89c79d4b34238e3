"""Put a learner together from a compiled task."""

from __future__ import annotations

import zlib

import gymnasium as gym
import numpy as np

from t4nmtd_dist.compiled import CompiledTask
from t4nmtd_dist.errors import WorldError
from t4nmtd_dist.high_level import QTable
from t4nmtd_dist.initial_state_buffer import InitialStateBuffer
from t4nmtd_dist.learners.attempts import Attempts
from t4nmtd_dist.learners.ppo import PPOLearner
from t4nmtd_dist.product import LetterReader, subtask_tables
from t4nmtd_dist.worlds import make_world


def subtask_seed(seed: int, pid: str, epoch: int) -> int:
    """A seed of its own for every sub-task and lease."""
    sequence = np.random.SeedSequence([seed, zlib.crc32(pid.encode()), epoch])
    return int(sequence.generate_state(1)[0] >> 1)


def build_learner(
    task: CompiledTask, pid: str, buffer: InitialStateBuffer, high_level: QTable, *, seed: int
) -> PPOLearner:
    """A learner for sub-task ``pid`` in worlds of its own.

    Raises:
        WorldError: if the environment cannot be opened, or its spaces or propositions do not fit.
    """
    config = task.config
    world = make_world(config.environment, config.ppo.worlds, config.propositions)
    if not isinstance(world.action_space, gym.spaces.Discrete):
        raise WorldError(f"PPO needs a Discrete action space; {config.environment.id} has {world.action_space}")
    tables = subtask_tables(
        task.dfa,
        task.decomposition,
        pid,
        task.rho,
        gamma=config.learner.gamma,
        shaping=config.learner.shaping,
    )
    attempts = Attempts(
        world,
        LetterReader(task.dfa, world.propositions),
        tables,
        task.dfa.delta,
        buffer,
        reset_q=task.dfa.initial if tables.available[task.dfa.initial] else None,
        attempt_steps=config.learner.attempt_steps,
        hand_over_all=config.learner.hand_over == "changes",
        rng=np.random.default_rng([seed, 0]),
    )
    return PPOLearner(
        pid,
        attempts,
        config.learner,
        config.ppo,
        high_level,
        dfa_states=task.dfa.states,
        actions=int(world.action_space.n),
        seed=seed,
    )
