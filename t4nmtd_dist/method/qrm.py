"""QRM: one network per DFA state, each learning from every step (Toro Icarte et al., 2018)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.method import mod, shared_rows
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.shared_rows import PolicyPerState

SHARES_ENV = True
decompose = shared_rows.decompose


def build(config: TaskConfig, dfa: DFA, decomposition: Decomposition, rho: NDArray[np.float64]) -> PolicyPerState:
    """See ``MethodModule.build``."""
    return mod.modules(config, dfa, decomposition, rho, rows="all")
