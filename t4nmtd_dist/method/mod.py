"""Mod: one module per DFA state, which acts until the state changes (Yuan et al., 2019; Hasanbeig et al., 2023).

A module bootstraps from the module of the state that it leads to.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.method import shared_rows
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.roles import role_of
from t4nmtd_dist.method.shared_rows import PolicyPerState

SHARES_ENV = True
decompose = shared_rows.decompose


def module_of(q: int) -> str:
    """Name of the module of a DFA state."""
    return f"q{q}"


def build(config: TaskConfig, dfa: DFA, decomposition: Decomposition, rho: NDArray[np.float64]) -> PolicyPerState:
    """See ``MethodModule.build``."""
    return modules(config, dfa, decomposition, rho, rows="own")


def modules(
    config: TaskConfig,
    dfa: DFA,
    decomposition: Decomposition,
    rho: NDArray[np.float64],
    *,
    rows: Literal["own", "all"],
) -> PolicyPerState:
    """A module for every DFA state with a transition; ``rows`` is what it learns from."""
    taken = decomposition.transitions
    by_source = Decomposition({module_of(q): tuple(tau for tau in taken if tau[0] == q) for q, _ in taken})
    acting = [module_of(q) if module_of(q) in by_source.subtasks else None for q in range(dfa.states)]
    return PolicyPerState([role_of(config, dfa, by_source, rho, name) for name in by_source.pids], acting, rows)
