"""Sub-tasks of the eight tasks and of small automata; transitions on simple paths."""

from __future__ import annotations

import json
import tomllib
from collections import Counter
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.automata.reduction import reduce_automaton
from t4nmtd_dist.automata.simple_paths import Edge, edges_on_simple_paths, simple_path_lengths
from t4nmtd_dist.automata.translate import translate
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.method.decomposition import Decomposition, Mode, decompose

COLOURS = ("red", "blue", "green", "black", "white", "grey")
EXPECTED = {
    "task1": dict.fromkeys(COLOURS, 7),
    "task2": dict.fromkeys((*COLOURS, "pink", "yellow"), 9),
    "task3": {"h4": 1, "h3": 1, "h2": 1},
    "task4": {"h2": 2, "h3": 2, "h4": 2},
    "task5": {"g1": 1, "g2": 1, "g3": 1, "g4": 1},
    "task6": {"g1": 10, "g2": 11, "g3": 11, "g4": 10},
    "task7": {"p1": 3, "p2": 3, "p3": 3, "g": 3},
    "task8": {"p1": 5, "p2": 5, "p3": 4, "g1": 4, "g2": 2},
}
UNDOING = {
    "task7": {"~p1": 1, "~p2": 1, "~p3": 1},
    "task8": {"~p1": 2, "~p2": 2, "~p3": 2},
}


@cache
def task(name: str) -> tuple[DFA, tuple[tuple[str, ...], ...]]:
    settings = tomllib.loads((files("t4nmtd_dist.tasks") / f"{name}.toml").read_text("utf-8"))
    exclusive = tuple(tuple(group) for group in settings.get("exclusive", ()))
    return translate(settings["formula"], propositions=settings.get("propositions")), exclusive


def sizes(decomposition: Decomposition) -> dict[str, int]:
    return {pid: len(taus) for pid, taus in decomposition.subtasks.items()}


def automaton(propositions: list[str], states: int, accepting: list[int], *edges: tuple[int, int, Any]) -> DFA:
    return DFA.from_json({
        "propositions": propositions, "states": states, "initial": 0, "accepting": accepting,
        "edges": [{"source": q, "target": target, "guard": guard} for q, target, guard in edges],
    })  # fmt: skip


@pytest.mark.parametrize("name", EXPECTED)
def test_the_eight_tasks_split_as_specified(name: str) -> None:
    dfa, exclusive = task(name)
    assert sizes(decompose(dfa, exclusive=exclusive)) == EXPECTED[name]


@pytest.mark.parametrize("name", EXPECTED)
def test_only_the_passenger_tasks_have_undoing_moves_to_prune(name: str) -> None:
    dfa, exclusive = task(name)
    expected = EXPECTED[name] | UNDOING.get(name, {})
    assert sizes(decompose(dfa, exclusive=exclusive, prune=False)) == expected


def test_task4_without_exclusive_markers_splits_as_specified() -> None:
    dfa, _ = task("task4")
    assert sizes(decompose(dfa)) == {"h2": 4, "h3": 3, "h4": 4, "h1": 1, "h5": 1}


def test_exclusive_markers_shrink_task4() -> None:
    dfa, exclusive = task("task4")
    reduced = reduce_automaton(dfa, exclusive)
    assert (dfa.states, len(dfa.edges)) == (9, 25)
    assert (len(reduced.states), len(reduced.transitions)) == (7, 17)


@pytest.mark.parametrize("mode", ["objective", "literal", "random"])
@pytest.mark.parametrize("prune", [True, False])
@pytest.mark.parametrize("name", ["task5", "task7", "task8"])
def test_no_sub_task_aims_at_an_error_a_self_loop_or_out_of_acceptance(name: str, prune: bool, mode: Mode) -> None:
    dfa, exclusive = task(name)
    for q, target in decompose(dfa, exclusive=exclusive, mode=mode, prune=prune).transitions:
        assert q != target
        assert q not in dfa.accepting
        assert target not in dfa.error


def test_q_target_and_available_follow_the_transitions() -> None:
    decomposition = Decomposition({"b": ((0, 2), (0, 1), (1, 2)), "a": ((1, 2),), "none": ()})
    assert decomposition.pids == ("a", "b")
    assert decomposition.subtasks["b"] == ((0, 1), (0, 2), (1, 2))
    assert decomposition.q_target("b", 0) == {1, 2}
    assert decomposition.q_target("a", 0) == frozenset()
    assert decomposition.available(0) == ("b",)
    assert decomposition.available(1) == ("a", "b")
    assert decomposition.available(2) == ()
    with pytest.raises(ConfigError, match="unknown sub-task 'c'; expected one of a, b"):
        decomposition.q_target("c", 0)


def test_json_round_trip_keeps_the_sub_tasks() -> None:
    decomposition = decompose(task("task8")[0])
    assert Decomposition.from_json(json.loads(json.dumps(decomposition.to_json()))) == decomposition
    with pytest.raises(ConfigError, match="expected"):
        Decomposition.from_json({"a": [1, 2]})


def test_what_holds_while_waiting_is_no_objective() -> None:
    dfa = automaton(["a", "b"], 3, [2], (0, 0, [["~a"]]), (0, 1, [["a"]]), (1, 1, [["a", "~b"]]),
                    (1, 0, [["~a"]]), (1, 2, [["a", "b"]]), (2, 2, [[]]))  # fmt: skip
    assert decompose(dfa).subtasks == {"a": ((0, 1),), "b": ((1, 2),)}
    assert decompose(dfa, mode="literal").subtasks == {"a": ((0, 1), (1, 2)), "b": ((1, 2),)}


def test_a_state_without_a_self_loop_entails_nothing_and_true_is_tick() -> None:
    dfa = automaton(["a"], 4, [3], (0, 1, [[]]), (1, 2, [["a"]]), (1, 3, [["~a"]]), (2, 2, [["a"]]),
                    (2, 3, [["~a"]]), (3, 3, [[]]))  # fmt: skip
    assert decompose(dfa).subtasks == {"a": ((1, 2),), "tick": ((0, 1),), "~a": ((1, 3), (2, 3))}


def test_a_proposition_named_tick_is_refused() -> None:
    dfa = automaton(["tick"], 2, [1], (0, 0, [["~tick"]]), (0, 1, [["tick"]]), (1, 1, [[]]))
    with pytest.raises(ConfigError, match="another name"):
        decompose(dfa)


def test_an_acceptance_that_only_excluded_letters_reach_is_refused() -> None:
    dfa = automaton(["a", "b"], 2, [1], (0, 0, [["~a"], ["~b"]]), (0, 1, [["a", "b"]]), (1, 1, [[]]))
    assert decompose(dfa).subtasks == {"a": ((0, 1),), "b": ((0, 1),)}
    with pytest.raises(ConfigError, match="exclusive propositions a, b"):
        decompose(dfa, exclusive=[["a", "b"]])


def test_an_unknown_mode_is_refused() -> None:
    with pytest.raises(ConfigError, match="unknown decomposition 'best'"):
        decompose(task("task5")[0], mode="best")  # type: ignore[arg-type]


@pytest.mark.parametrize("name", EXPECTED)
def test_the_random_decomposition_deals_the_same_transitions_evenly(name: str) -> None:
    dfa, exclusive = task(name)
    objective = decompose(dfa, exclusive=exclusive)
    dealt = decompose(dfa, exclusive=exclusive, mode="random", seed=3)
    assert len(dealt.pids) == len(objective.pids)
    assert Counter(tau for taus in dealt.subtasks.values() for tau in taus) == Counter(
        tau for taus in objective.subtasks.values() for tau in taus
    )
    assert max(sizes(dealt).values()) - min(sizes(dealt).values()) <= 1


def test_the_random_decomposition_depends_on_its_seed_alone() -> None:
    dfa, _ = task("task8")
    deals = [decompose(dfa, mode="random", seed=seed) for seed in (0, 0, 1)]
    assert deals[0] == deals[1]
    assert deals[0] != deals[2]


def paths_by_enumeration(edges: set[Edge], source: int, targets: set[int]) -> list[list[Edge]]:
    if source in targets:
        return [[]]
    onward = {(q, t) for q, t in edges if source not in (q, t)}
    return [
        [(source, step), *rest]
        for step in sorted(t for q, t in edges if q == source)
        for rest in paths_by_enumeration(onward, step, targets)
    ]


@st.composite
def graphs(draw: st.DrawFn) -> tuple[set[Edge], set[int]]:
    n = draw(st.integers(2, 7))
    targets = draw(st.sets(st.integers(1, n - 1), min_size=1, max_size=2))
    pairs = [(q, t) for q in range(n) for t in range(n) if q != t and q not in targets]
    return draw(st.sets(st.sampled_from(pairs), max_size=18)), targets


@pytest.mark.slow
@settings(max_examples=300)
@given(graphs())
def test_pruning_keeps_exactly_the_edges_of_simple_paths(graph: tuple[set[Edge], set[int]]) -> None:
    edges, targets = graph
    paths = paths_by_enumeration(edges, 0, targets)
    assert edges_on_simple_paths(edges, 0, targets) == {edge for path in paths for edge in path}
    assert sorted(simple_path_lengths(edges, 0, targets)) == sorted(map(len, paths))


def test_a_tangled_graph_of_thirty_states_is_pruned_quickly() -> None:
    rng = np.random.default_rng(0)
    edges = {(int(q), int(t)) for q, t in rng.integers(0, 30, (110, 2)) if q not in (29, t)}
    found = edges_on_simple_paths(edges, 0, {29})
    assert 0 < len(found) < len(edges)
