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
from t4nmtd_dist.learners.protocol import Learner
from t4nmtd_dist.product import LetterReader, SubtaskTables, subtask_tables
from t4nmtd_dist.worlds import BatchedWorld, make_world


def subtask_seed(seed: int, pid: str, epoch: int) -> int:
    """A seed of its own for every sub-task and lease."""
    sequence = np.random.SeedSequence([seed, zlib.crc32(pid.encode()), epoch])
    return int(sequence.generate_state(1)[0] >> 1)


def build_learner(
    task: CompiledTask, pid: str, buffer: InitialStateBuffer, high_level: QTable, *, seed: int
) -> Learner:
    """A learner for sub-task ``pid`` in worlds of its own.

    Raises:
        WorldError: if the environment cannot be opened, or its spaces or propositions do not fit.
    """
    config = task.config
    tables = subtask_tables(
        task.dfa,
        task.decomposition,
        pid,
        task.rho,
        gamma=config.learner.gamma,
        shaping=config.learner.shaping,
    )
    count = config.sac.worlds if config.learner.algorithm == "sac" else config.ppo.worlds
    world = make_world(config.environment, count, config.propositions)
    attempts = _attempts(task, tables, world, buffer, seed)
    space = world.action_space
    if config.learner.algorithm == "ppo":
        if not isinstance(space, gym.spaces.Discrete):
            raise WorldError(f"PPO needs a Discrete action space; {config.environment.id} has {space}")
        return PPOLearner(
            pid,
            attempts,
            config.learner,
            config.ppo,
            high_level,
            dfa_states=task.dfa.states,
            actions=int(space.n),
            seed=seed,
        )
    if not isinstance(space, gym.spaces.Box):
        raise WorldError(f"SAC needs a Box action space; {config.environment.id} has {space}")
    from t4nmtd_dist.learners.sac import SACLearner

    return SACLearner(
        pid, attempts, tables, task.dfa.delta, config.learner, config.sac, high_level, actions=space, seed=seed
    )


def _attempts(
    task: CompiledTask, tables: SubtaskTables, world: BatchedWorld, buffer: InitialStateBuffer, seed: int
) -> Attempts:
    settings = task.config.learner
    return Attempts(
        world,
        LetterReader(task.dfa, world.propositions),
        tables,
        task.dfa.delta,
        buffer,
        reset_q=task.dfa.initial if tables.available[task.dfa.initial] else None,
        attempt_steps=settings.attempt_steps,
        hand_over_all=settings.hand_over == "changes",
        rng=np.random.default_rng([seed, 0]),
    )
