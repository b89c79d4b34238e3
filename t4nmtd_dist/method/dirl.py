"""DIRL: Dijkstra's search trains the edges of the automaton and finds the path (Jothimurugan et al., 2021).

An edge's attempts start in states that the policy of its parent reached while that policy's success was estimated,
uniform over the distinct ones among the last 200. Estimates are made by the greedy policy, as evaluations are, which
neither explores nor learns meanwhile. Rewards are those of labels: the original's distance to a region is not known
here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.core.setting_types import CountOrZero
from t4nmtd_dist.method import edges
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.dirl_planner import Planner


@dataclass(frozen=True)
class DIRLConfig:
    """Settings of DIRL.

    Attributes:
        edge_interactions: interactions after which the training of an edge ends; 0 for ``max_interactions`` divided by
            the number of edges.
    """

    edge_interactions: CountOrZero = 0


CONFIG = DIRLConfig
decompose = edges.decompose


def build(config: TaskConfig, dfa: DFA, decomposition: Decomposition, rho: NDArray[np.float64]) -> edges.EdgeMethod:
    """See ``MethodModule.build``."""
    transitions = edges.edges_of(decomposition)
    equal_share = max(1, config.max_interactions // len(transitions))
    planner = Planner(
        transitions, dfa.initial, dfa.accepting, interactions=config.method.edge_interactions or equal_share
    )
    return edges.EdgeMethod(config, dfa, decomposition, rho, planner)
