"""Roles: a method's policies, each with its tabulated targets, rewards and starts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.rewards import ACCEPTANCE_REWARD, SubtaskTables, subtask_tables


@dataclass(frozen=True)
class Role:
    """One policy of a method: a sub-task in T4NMTD, a DFA state or an edge in others.

    Attributes:
        name: its name in the decomposition, leases, files and messages.
        tables: its targets and rewards.
        reset_q: the initial DFA state if the role is available there, so that attempts can start at the environment's
            reset; else None.
        attempt_steps: maximum length of an attempt; a truncation, not a terminal.
        network: name of its network, where one learner holds several; by default its own name.
        goal: index of the one-hot input that distinguishes roles of one network; None without one.
    """

    name: str
    tables: SubtaskTables
    reset_q: int | None
    attempt_steps: int
    network: str
    goal: int | None = None

    def stranded(self, q: NDArray[np.int32], q_next: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Steps on which the DFA moved to a state without a transition of the role, bool [N]."""
        found: NDArray[np.bool_] = (q_next != q) & ~self.tables.available[q_next]
        return found


def role_of(config: TaskConfig, dfa: DFA, decomposition: Decomposition, rho: NDArray[np.float64], name: str) -> Role:
    """Tabulate one role of a decomposition with the task's shaping, penalty and limits.

    ``config.acceptance`` must be resolved; ``rho`` is the potential of every DFA state, float64 [Q].
    """
    settings = config.learner
    tables = subtask_tables(
        dfa,
        decomposition,
        name,
        rho,
        gamma=settings.gamma,
        shaping=settings.shaping,
        error_penalty=error_penalty(config),
    )
    reset_q = dfa.initial if tables.available[dfa.initial] else None
    return Role(name, tables, reset_q, _attempt_steps(config, tables), network=name)


def error_penalty(config: TaskConfig) -> float:
    """Penalty of a step into an error state.

    With success only at the episode's end, a late error must be better than an early one.
    """
    least = ACCEPTANCE_REWARD if config.acceptance == "end" else 0.0
    return max(config.learner.error_penalty, least)


def _attempt_steps(config: TaskConfig, tables: SubtaskTables) -> int:
    """Attempts at goals reached only at the episode's end must last until then."""
    steps = config.learner.attempt_steps
    waits_for_end = config.acceptance == "end" and not tables.target[:, ~tables.accepting].any()
    return max(steps, config.environment.horizon) if waits_for_end else steps
