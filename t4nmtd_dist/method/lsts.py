"""LSTS: a teacher chooses which edge of the automaton trains, by progress (Shukla et al., 2024).

An edge's attempts start in states in which the learned edge into its source arrived, restored as T4NMTD restores them.
Not built: the variant that executes the learned edges from the reset instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.core.setting_types import Count
from t4nmtd_dist.method import edges
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.lsts_teacher import Teacher


@dataclass(frozen=True)
class LSTSConfig:
    """Settings of LSTS.

    Attributes:
        slice_attempts: attempts of an edge between two choices of the teacher.
    """

    slice_attempts: Count = 50


CONFIG = LSTSConfig
decompose = edges.decompose


def build(config: TaskConfig, dfa: DFA, decomposition: Decomposition, rho: NDArray[np.float64]) -> edges.EdgeMethod:
    """See ``MethodModule.build``."""
    teacher = Teacher(
        edges.edges_of(decomposition), dfa.initial, dfa.accepting, slice_attempts=config.method.slice_attempts
    )
    return edges.EdgeMethod(config, dfa, decomposition, rho, teacher)
