"""HRM: one option per transition, and an upper level that chooses among them (Toro Icarte et al., 2022).

An option ends at the first change of the DFA state. Every step trains every option, read in the state that the option's
transition leaves. One network serves all options, with a one-hot of the option as a further input.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.method import shared_rows
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.options import LinearSchedule, OptionMethod, option_role, paid_above
from t4nmtd_dist.method.protocol import Reading, States

SHARES_ENV = True
decompose = shared_rows.decompose


def build(config: TaskConfig, dfa: DFA, decomposition: Decomposition, rho: NDArray[np.float64]) -> HRM:
    """See ``MethodModule.build``."""
    taken = Decomposition({f"q{q}-q{target}": ((q, target),) for q, target in decomposition.transitions})
    roles = [option_role(config, dfa, taken, rho, name) for name in taken.pids]
    return HRM(
        roles,
        gamma=config.learner.gamma,
        smdp=True,
        epsilon=LinearSchedule(config.high_level.epsilon, config.high_level.epsilon),
        environment=paid_above(config, dfa),
    )


class HRM(OptionMethod):
    """Transitions as options; see ``Method``."""

    def ends(self, role: str, q: States, q_next: States, steps: States) -> NDArray[np.int8]:
        """An option ends at any change of the DFA state; it has no time limit of its own."""
        return self.passed_on(np.not_equal(q, q_next), q_next)

    def reads(self, role: str) -> Reading:
        """All rows, read in the state that the transition leaves."""
        return Reading(np.flatnonzero(self.role(role).tables.available).astype(np.int32), "all")
