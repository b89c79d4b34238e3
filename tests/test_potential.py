"""Distances and potentials of the tasks and of small automata."""

from __future__ import annotations

import math
import tomllib
from importlib.resources import files

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.automata.translate import translate
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.method.decomposition import decompose
from t4nmtd_dist.method.potential import distances, potentials


def task(name: str) -> tuple[DFA, list[list[str]]]:
    settings = tomllib.loads((files("t4nmtd_dist.tasks") / f"{name}.toml").read_text("utf-8"))
    dfa = translate(settings["formula"], propositions=settings.get("propositions"))
    return dfa, settings.get("exclusive", [])


def complete_graph(states: int) -> DFA:
    """Every state but the last, accepting one can go to every other; symbols beyond that stay."""
    bits = (states - 1).bit_length()
    delta = np.array([[a if a < states else q for a in range(1 << bits)] for q in range(states)], dtype=np.int32)
    delta[-1] = states - 1
    return DFA(tuple(f"p{i:02}" for i in range(bits)), delta, frozenset({states - 1}))


def test_a_chain_counts_down_and_its_error_state_ranks_with_the_farthest() -> None:
    dfa, _ = task("task5")
    dist = distances(dfa)
    (error,) = dfa.error
    assert math.isinf(dist[error])
    assert sorted(d for d in dist.values() if math.isfinite(d)) == [0, 1, 2, 3, 4]
    rho = potentials(dfa, dist)
    assert rho[0] == pytest.approx(20)
    assert rho[error] == pytest.approx(20)
    assert [rho[q] for q in dfa.accepting] == [100]


def test_the_constant_scales_the_potential() -> None:
    dfa, _ = task("task7")
    dist = distances(dfa)
    assert potentials(dfa, dist, 1.0) * 100 == pytest.approx(potentials(dfa, dist))


def test_mean_distance_of_task7_is_that_over_simple_paths() -> None:
    dfa, _ = task("task7")
    shortest, mean = distances(dfa), distances(dfa, mode="mean")
    assert shortest[0] == 2
    assert mean[0] == pytest.approx((3 * 2 + 6 * 3 + 6 * 4) / 15)


@pytest.mark.parametrize(("name", "paying_nothing", "transitions"), [("task7", 6, 12), ("task8", 8, 20)])
def test_mean_distance_leaves_sub_task_transitions_unpaid(name: str, paying_nothing: int, transitions: int) -> None:
    dfa, _ = task(name)
    aims = decompose(dfa).transitions
    rho = potentials(dfa, distances(dfa, mode="mean"))
    assert len(aims) == transitions
    assert sum(0.99 * rho[target] - rho[q] <= 0 for q, target in aims) == paying_nothing


def test_states_that_only_excluded_letters_reach_are_out_of_reach() -> None:
    dfa, exclusive = task("task4")
    everywhere, dist = distances(dfa), distances(dfa, exclusive=exclusive)
    lost = {q for q in dist if math.isinf(dist[q])} - dfa.error
    assert len(lost) == 2
    assert all(math.isfinite(everywhere[q]) for q in lost)
    rho = potentials(dfa, dist)
    assert {float(rho[q]) for q in lost | dfa.error} == {100 / (max(d for d in dist.values() if d < 99) + 1)}


def test_too_many_simple_paths_are_an_error_that_says_so() -> None:
    dfa = complete_graph(11)
    assert distances(dfa)[0] == 1
    with pytest.raises(ConfigError, match=r"100,000 simple paths.*dist=shortest"):
        distances(dfa, mode="mean")


def test_an_unknown_mode_is_refused() -> None:
    with pytest.raises(ConfigError, match="unknown dist 'average'; expected one of shortest, mean"):
        distances(task("task5")[0], mode="average")  # type: ignore[arg-type]


@st.composite
def automata(draw: st.DrawFn) -> DFA:
    states = draw(st.integers(2, 6))
    row = st.lists(st.integers(0, states - 1), min_size=4, max_size=4)
    delta = np.array([draw(row) for _ in range(states)], dtype=np.int32)
    accepting = draw(st.sets(st.integers(1, states - 1), max_size=2))
    return DFA(("a", "b"), delta, frozenset(accepting))


@given(automata(), st.sampled_from([(), (("a", "b"),)]))
def test_shortest_distance_obeys_its_own_equation(dfa: DFA, exclusive: tuple[tuple[str, ...], ...]) -> None:
    dist, mean = distances(dfa, exclusive=exclusive), distances(dfa, exclusive=exclusive, mode="mean")
    symbols = [0, 1, 2] if exclusive else [0, 1, 2, 3]
    reached = {0}
    for _ in range(dfa.states):
        reached |= {int(dfa.delta[q, a]) for q in reached for a in symbols}
    for q in range(dfa.states):
        if q not in reached:
            assert math.isinf(dist[q])
        elif q in dfa.accepting:
            assert dist[q] == 0
        else:
            assert dist[q] == 1 + min(dist[int(dfa.delta[q, a])] for a in symbols)
        assert mean[q] >= dist[q]
        assert math.isinf(mean[q]) == math.isinf(dist[q])
    rho = potentials(dfa, dist)
    assert np.isfinite(rho).all()
    assert (rho > 0).all()
    assert (rho <= 100).all()
