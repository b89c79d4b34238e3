"""Product: one policy for environment and DFA state together, without relabelling; the control of CRM."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.method import shared_rows
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.roles import role_of
from t4nmtd_dist.method.shared_rows import PolicyPerState, live_states

SHARES_ENV = True
decompose = shared_rows.decompose


def build(config: TaskConfig, dfa: DFA, decomposition: Decomposition, rho: NDArray[np.float64]) -> PolicyPerState:
    """See ``MethodModule.build``."""
    return one_policy(config, dfa, decomposition, rho, rows="own")


def one_policy(
    config: TaskConfig,
    dfa: DFA,
    decomposition: Decomposition,
    rho: NDArray[np.float64],
    *,
    rows: Literal["own", "all"],
) -> PolicyPerState:
    """One role that acts in every DFA state outside F and E; ``rows`` is what it learns from."""
    live = set(live_states(config, dfa).tolist())
    (name,) = decomposition.pids
    acting = [name if q in live else None for q in range(dfa.states)]
    return PolicyPerState([role_of(config, dfa, decomposition, rho, name)], acting, rows)
