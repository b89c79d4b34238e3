"""Distances to acceptance, and the potential rho of DFA states for reward shaping."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import islice
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.acceptance import unfulfilled_states
from t4nmtd_dist.automata.deadline import Deadline
from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.automata.reduction import (
    ExclusiveGroups,
    ReducedAutomaton,
    reduce_automaton,
    shortest_distances,
)
from t4nmtd_dist.automata.simple_paths import simple_path_lengths
from t4nmtd_dist.core.errors import ConfigError

DistanceMode = Literal["shortest", "mean"]

PATH_LIMIT = 100_000


def distances(
    dfa: DFA, *, exclusive: ExclusiveGroups = (), mode: DistanceMode = "shortest", deadline: Deadline | None = None
) -> dict[int, float]:
    """dist(q) of every state: the number of transitions from q to acceptance.

    Ignores self-loops and symbols excluded by ``exclusive``. If the trace ends with the episode, a final step that
    makes the formula true counts as two.

    Args:
        dfa: the task automaton.
        exclusive: groups of propositions that never hold together.
        mode: ``shortest`` path, or the ``mean`` over all simple paths (the paper's average distance).
        deadline: of the compilation.

    Returns:
        state -> distance: 0 on F; infinite on E and on states that only excluded symbols reach.

    Raises:
        ConfigError: for an unknown mode, over 100,000 simple paths with ``mean``, or a passed deadline.
    """
    if mode not in get_args(DistanceMode):
        raise ConfigError(f"unknown dist {mode!r}; expected one of {', '.join(get_args(DistanceMode))}")
    reduced = reduce_automaton(dfa, exclusive)
    finite = (
        shortest_distances(reduced.progress, reduced.accepting, unfulfilled_states(dfa))
        if mode == "shortest"
        else _means(reduced, deadline)
    )
    return {q: finite.get(q, math.inf) for q in range(dfa.states)}


def potentials(dfa: DFA, dist: Mapping[int, float], constant: float = 100.0) -> NDArray[np.float64]:
    """The potential rho(q) = C / (dist(q) + 1), which is C on F; ``dist`` is from ``distances``.

    Returns:
        float64 array of shape (states,). States at infinite distance have C / (D_max + 1), D_max being the largest
        finite distance.
    """
    exact = np.array([dist[q] for q in range(dfa.states)], dtype=np.float64)
    farthest = max((d for d in exact if math.isfinite(d)), default=0.0)
    rho: NDArray[np.float64] = constant / (np.minimum(exact, farthest) + 1.0)
    return rho


def _means(reduced: ReducedAutomaton, deadline: Deadline | None) -> dict[int, float]:
    """Mean length of the simple paths from each state to F."""
    left = PATH_LIMIT
    means: dict[int, float] = {}
    for q in sorted(reduced.states - reduced.error):
        lengths = list(islice(simple_path_lengths(reduced.progress, q, reduced.accepting, deadline), left + 1))
        left -= len(lengths)
        if left < 0:
            raise ConfigError(f"dist=mean: more than {PATH_LIMIT:,} simple paths lead to acceptance; use dist=shortest")
        means[q] = sum(lengths) / len(lengths)
    return means
