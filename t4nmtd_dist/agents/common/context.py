"""Inputs for building a learner."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.normalisation import Normalisation
from t4nmtd_dist.agents.common.rollout import Rollout
from t4nmtd_dist.core.config import LearnerConfig
from t4nmtd_dist.core.devices import Device
from t4nmtd_dist.environments.action_spaces import Bounds, action_bounds, action_count
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.method.protocol import Method


@dataclass(frozen=True)
class AgentContext:
    """Sub-task, environments and settings of one learner.

    Attributes:
        pid: the sub-task.
        task: the compiled task.
        rollout: N environments in which the learner attempts the sub-task.
        action_space: of the environment.
        method: the learner's copy; the coordinator updates its high level.
        seed: for networks and sampling.
        device: of the trained networks; the rollout and answers to peers stay on the CPU.
        normalised: which observation entries are normalised, bool [d].
        goals: length of the one-hot goal after the DFA state, for networks shared by several roles.
    """

    pid: str
    task: CompiledTask
    rollout: Rollout
    action_space: object
    method: Method
    seed: int
    device: Device
    normalised: NDArray[np.bool_]
    goals: int = 0

    @property
    def settings(self) -> LearnerConfig:
        """Settings shared by all learners."""
        return self.task.config.learner

    @property
    def dfa_states(self) -> int:
        """|Q|."""
        return self.task.dfa.states

    @property
    def observation_size(self) -> int:
        """Length of an observation, d."""
        return len(self.normalised)

    @property
    def inputs(self) -> int:
        """Length of a network's input, d + |Q| + goals."""
        return self.observation_size + self.dfa_states + self.goals

    def action_count(self) -> int:
        """Number of discrete actions.

        Raises:
            EnvError: if the action space is not Discrete.
        """
        return action_count(self.action_space, self.task.config.environment.id, self.settings.algorithm.upper())

    def action_bounds(self) -> Bounds:
        """Lowest and highest continuous actions, float32 [A] each.

        Raises:
            EnvError: if the action space is not a one-dimensional Box of real numbers with finite bounds.
        """
        return action_bounds(self.action_space, self.task.config.environment.id, self.settings.algorithm.upper())

    def rng(self) -> np.random.Generator:
        """A generator with the learner's seed; each call returns a new one."""
        return np.random.default_rng([self.seed, 1])

    def normalisation(self) -> Normalisation:
        """Empty observation statistics."""
        return Normalisation(self.normalised)
