"""Sub-tasks that help: those that never bring acceptance nearer are left out, equal ones become one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_decomposition import EXPECTED, UNDOING, automaton, sizes, task
from test_semantics import formula_texts

from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.automata.formula import names_in_order
from t4nmtd_dist.automata.reduction import allowed_symbols, reduce_automaton
from t4nmtd_dist.automata.translate import translate
from t4nmtd_dist.core.config import DecompositionConfig, TaskConfig, task_config
from t4nmtd_dist.core.errors import ConfigError, FormulaError
from t4nmtd_dist.launch.program import assign_pids
from t4nmtd_dist.method.compiled import compile_task
from t4nmtd_dist.method.decomposition import Decomposition, decompose
from t4nmtd_dist.runs.directory import RunDirectory
from t4nmtd_dist.runs.event_files import EventFiles
from t4nmtd_dist.runs.file_names import file_name
from t4nmtd_dist.runs.resuming import checkpoint_folder, new_identity, read_stopped_run, write_identity
from t4nmtd_dist.tasks import load_task


def helpful(formula: str, exclusive: tuple[tuple[str, ...], ...] = ()) -> Decomposition:
    dfa = translate(formula, translator="python")
    return decompose(dfa, exclusive=exclusive, keep="helpful", order=names_in_order(formula))


def test_equal_sub_tasks_become_one() -> None:
    assert helpful("F(red & magenta)").subtasks == {"red&magenta": ((0, 1),)}
    assert helpful("F(c & a & b & X(F d))").pids == ("c&a&b", "d")


def test_a_sub_task_that_never_brings_acceptance_nearer_is_left_out() -> None:
    found = helpful("G(a -> F b) & F c")
    assert found.pids == ("b", "c")
    assert found.left_out == ("a",)


@pytest.mark.parametrize(
    ("formula", "left_out", "kept"),
    [
        ("!a U (b & X(!a U c))", ("a",), ("b", "c")),
        ("!a U (b & X(c U d))", ("a", "c"), ("b", "d")),
        ("(!a U b) & F a", (), ("a", "b")),
        ("(!a U b) & F(a | c)", (), ("a", "b", "c")),
        ("F(a & b) | (F b & F c)", (), ("a", "b", "c")),
    ],
)
def test_what_is_to_be_avoided_gets_no_learner_unless_it_is_needed_later(
    formula: str, left_out: tuple[str, ...], kept: tuple[str, ...]
) -> None:
    found = helpful(formula)
    assert (found.left_out, found.pids) == (left_out, kept)


def test_the_rule_of_the_paper_stays_as_a_setting() -> None:
    dfa = translate("F(red & magenta)")
    assert decompose(dfa, keep="all").pids == ("magenta", "red")
    assert decompose(dfa, keep="all").left_out == ()
    assert decompose(dfa, mode="literal", keep="helpful").pids == ("magenta", "red")
    with pytest.raises(ConfigError, match="unknown keep 'some'; expected one of helpful, all"):
        decompose(dfa, keep="some")  # type: ignore[arg-type]


def test_the_setting_is_on_by_default_and_reaches_compiled_tasks() -> None:
    assert DecompositionConfig().keep == "helpful"
    config = joint_task()
    assert compile_task(config).decomposition.pids == ("red&blue",)
    every = replace(config, decomposition=DecompositionConfig(keep="all"))
    assert compile_task(every).decomposition.pids == ("blue", "red")


@pytest.mark.parametrize("name", EXPECTED)
def test_the_eight_tasks_keep_their_sub_tasks(name: str) -> None:
    dfa, exclusive = task(name)
    found = decompose(dfa, exclusive=exclusive, keep="helpful")
    assert found == decompose(dfa, exclusive=exclusive, keep="all")
    assert found.left_out == ()
    undone = decompose(dfa, exclusive=exclusive, keep="helpful", prune=False)
    assert sizes(undone) == EXPECTED[name] | UNDOING.get(name, {})


def test_task4_without_exclusive_markers_loses_two_sidesteps() -> None:
    found = decompose(task("task4")[0], keep="helpful")
    assert sizes(found) == {"h2": 4, "h3": 3, "h4": 4}
    assert found.left_out == ("h1", "h5")


def test_the_random_decomposition_has_as_many_sub_tasks_as_are_kept() -> None:
    dfa = translate("F(red & magenta & X(F blue))")
    dealt_at_random = decompose(dfa, mode="random", keep="helpful")
    assert dealt_at_random.pids == ("r1", "r2")
    assert dealt_at_random.transitions == decompose(dfa).transitions


def test_distances_do_not_count_transitions_that_were_pruned() -> None:
    """From 2 the nearest way leads back over 1, on no simple path; so ``e``, the longer way, must stay."""
    dfa = automaton(["a", "b", "c", "d", "e", "f", "g"], 6, [5], (0, 0, [["~a"]]), (0, 1, [["a"]]),
                    (1, 1, [["~b", "~c"]]), (1, 2, [["c", "~b"]]), (1, 5, [["b"]]),
                    (2, 2, [["~d", "~e"]]), (2, 1, [["d", "~e"]]), (2, 3, [["e"]]),
                    (3, 3, [["~f"]]), (3, 4, [["f"]]), (4, 4, [["~g"]]), (4, 5, [["g"]]), (5, 5, [[]]))  # fmt: skip
    found = decompose(dfa, keep="helpful")
    assert found.left_out == ("c",)
    assert found.available(2) == ("e",)


def reached(initial: int, transitions: tuple[tuple[int, int], ...]) -> set[int]:
    found, frontier = {initial}, [initial]
    while frontier:
        q = frontier.pop()
        fresh = {target for source, target in transitions if source == q} - found
        found |= fresh
        frontier.extend(fresh)
    return found


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(formula_texts(), st.sampled_from([(), (("a", "b"),), (("a", "b", "c"),)]), st.booleans())
def test_every_state_keeps_a_way_to_acceptance(
    formula: str, exclusive: tuple[tuple[str, ...], ...], prune: bool
) -> None:
    try:
        dfa = translate(formula, translator="python")
        named = tuple(group for group in exclusive if set(group) <= set(dfa.propositions))
        every = decompose(dfa, exclusive=named, prune=prune, keep="all")
    except (FormulaError, ConfigError):
        return
    kept = decompose(dfa, exclusive=named, prune=prune, keep="helpful")
    accepting = reduce_automaton(dfa, named).accepting
    for q in range(dfa.states):
        able = bool(every.available(q))
        assert bool(kept.available(q)) == able
        if able:
            assert reached(q, kept.transitions) & accepting
    assert set(kept.transitions) <= set(every.transitions)
    assert len(set(kept.subtasks.values())) == len(kept.pids)
    assert sorted([*kept.left_out, *(name for pid in kept.pids for name in pid.split("&"))]) == sorted(every.pids)
    if not prune:
        assert kept.left_out == ()
    assert_left_out_never_help(dfa, every, kept, named)


def assert_left_out_never_help(
    dfa: DFA, every: Decomposition, kept: Decomposition, exclusive: tuple[tuple[str, ...], ...]
) -> None:
    """Whatever a left-out literal reaches, the symbol without it comes at least as near to acceptance."""
    dist = distances_over(every.transitions, reduce_automaton(dfa, exclusive).accepting, dfa.states)
    allowed = allowed_symbols(dfa, exclusive)
    for pid in set(kept.left_out) - {"tick"}:
        bit = dfa.symbol([pid.removeprefix("~")])
        for q, target in every.subtasks[pid]:
            for symbol in np.flatnonzero(dfa.symbols(q, target) & allowed):
                if bool(symbol & bit) == pid.startswith("~") or not allowed[symbol ^ bit]:
                    continue
                assert dist[target] >= dist[q] or dist[int(dfa.delta[q, symbol ^ bit])] <= dist[target]


def distances_over(transitions: tuple[tuple[int, int], ...], accepting: frozenset[int], states: int) -> list[float]:
    dist = [0.0 if q in accepting else np.inf for q in range(states)]
    for _ in range(states):
        for q, target in transitions:
            dist[q] = min(dist[q], dist[target] + 1)
    return dist


# Names with & and ~ as files


def test_a_name_is_safe_in_file_names_everywhere(tmp_path: Path) -> None:
    assert file_name("~p1&p2") == "not-p1+p2"
    assert checkpoint_folder(tmp_path, "a&b").name == "a+b"
    assert assign_pids(["a&b", "~c"], None) == {"a+b": ["a&b"], "not-c": ["~c"]}
    RunDirectory(tmp_path / "run").append_metrics("a&~b", {"x": 1})
    assert (tmp_path / "run" / "metrics" / "a+not-b.csv").read_text("utf-8").splitlines() == ["x", "1"]
    events = EventFiles(tmp_path / "board")
    events.add("a&~b", 1, {"success": 1.0})
    events.close()
    assert [folder.name for folder in (tmp_path / "board").iterdir()] == ["a+not-b"]


@given(st.sets(st.text("ab~&", min_size=1, max_size=8), max_size=6))
def test_different_sub_tasks_have_different_files(names: set[str]) -> None:
    assert len({file_name(name) for name in names}) == len(names)


def test_a_long_name_fits_into_a_file_name(tmp_path: Path) -> None:
    names = ["&".join(f"a_rather_long_proposition_{i:02}" for i in range(n)) for n in (15, 16)]
    assert len({file_name(name) for name in names}) == 2
    for name in names:
        (tmp_path / f"{file_name(name)}.csv").touch()


# Runs and policies from before the setting


def joint_task() -> TaskConfig:
    data = load_task("task7").to_dict()
    data |= {"formula": "F(red & blue)", "propositions": ["red", "blue"]}
    return task_config(data)


def test_settings_without_the_key_load_and_a_new_run_has_it(tmp_path: Path) -> None:
    data = load_task("task7").to_dict()
    del data["decomposition"]["keep"]
    assert task_config(json.loads(json.dumps(data))).decomposition.keep == "helpful"
    run = RunDirectory(tmp_path / "run")
    run.write_settings(load_task("task7"), 0, 1)
    write_identity(run.path, new_identity(serial=True))
    assert 'keep = "helpful"' in (run.path / "config.toml").read_text("utf-8")
    assert read_stopped_run(run.path).config.decomposition.keep == "helpful"
