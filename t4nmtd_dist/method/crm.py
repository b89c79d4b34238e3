"""CRM: one policy that learns from every step as if it had been made in each DFA state (Toro Icarte et al., 2022)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.method import product, shared_rows
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.shared_rows import PolicyPerState

SHARES_ENV = True
decompose = shared_rows.decompose


def build(config: TaskConfig, dfa: DFA, decomposition: Decomposition, rho: NDArray[np.float64]) -> PolicyPerState:
    """See ``MethodModule.build``."""
    return product.one_policy(config, dfa, decomposition, rho, rows="all")
