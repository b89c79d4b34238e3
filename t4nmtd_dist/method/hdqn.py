"""h-DQN: an upper level chooses goals, and one network pursues the chosen one (Kulkarni et al., 2016).

The goals are T4NMTD's sub-tasks. A goal ends at any change of the DFA state, reached or not, and after
``learner.attempt_steps``. The upper level learns from the sum of the environment's rewards, with one discount per
decision.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.deadline import Deadline
from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.method import shared_rows, t4nmtd
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.options import LinearSchedule, OptionMethod, option_role
from t4nmtd_dist.method.protocol import Reading, States
from t4nmtd_dist.method.rewards import environment_rewards
from t4nmtd_dist.method.roles import error_penalty
from t4nmtd_dist.method.shared_rows import LEARNER

SHARES_ENV = True
EXPLORED_DECISIONS = 2000
"""Choices over which the upper level's exploration decreases from 1 to ``high_level.epsilon``."""


def decompose(config: TaskConfig, dfa: DFA, *, seed: int, deadline: Deadline | None) -> Decomposition:
    """One learner with the transitions of all goals; see ``MethodModule.decompose``."""
    shared_rows.decompose(config, dfa, seed=seed, deadline=deadline)
    return Decomposition({LEARNER: t4nmtd.decompose(config, dfa, seed=seed, deadline=deadline).transitions})


def build(config: TaskConfig, dfa: DFA, decomposition: Decomposition, rho: NDArray[np.float64]) -> HDQN:
    """See ``MethodModule.build``."""
    goals = t4nmtd.decompose(config, dfa, seed=0, deadline=None)
    return HDQN(
        [option_role(config, dfa, goals, rho, name) for name in goals.pids],
        gamma=config.learner.gamma,
        smdp=False,
        epsilon=LinearSchedule(1.0, config.high_level.epsilon, EXPLORED_DECISIONS),
        environment=environment_rewards(dfa, error_penalty=error_penalty(config)),
    )


class HDQN(OptionMethod):
    """Sub-tasks as goals; see ``Method``."""

    def ends(self, role: str, q: States, q_next: States, steps: States) -> NDArray[np.int8]:
        """A goal ends at any change of the DFA state, and when its steps are spent."""
        return self.passed_on((q != q_next) | (steps >= self.role(role).attempt_steps), q_next)

    def reads(self, role: str) -> Reading:
        """Rows recorded while this goal was pursued."""
        return Reading(np.flatnonzero(self.role(role).tables.available).astype(np.int32), "own")
