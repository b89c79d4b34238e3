"""From the text of a formula to its automaton: the eight tasks, error messages, MONA as a process."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
import timeit
import tomllib
from concurrent.futures import ThreadPoolExecutor
from importlib import resources
from pathlib import Path
from typing import Any

import pytest

from t4nmtd_dist.automata.formula import parse
from t4nmtd_dist.automata.macros import strict_then, then
from t4nmtd_dist.automata.minimise import check_size
from t4nmtd_dist.automata.mona import find_mona, mona_program, read_table
from t4nmtd_dist.automata.translate import Translator, translate
from t4nmtd_dist.core.errors import ConfigError, FormulaError, TranslationError

SIZES = {1: (17, 65), 2: (26, 106), 3: (5, 11), 4: (9, 25), 5: (6, 15), 6: (18, 69), 7: (6, 26), 8: (11, 47)}

needs_mona = pytest.mark.skipif(find_mona() is None, reason="the program mona is not installed")
TRANSLATORS = [pytest.param("mona", marks=needs_mona), "python"]

TASK3 = strict_then(["h4", "h3", "h2"], [["h2", "h4"], ["h3", "h5"], ["h2", "h4"]])
TASK4 = strict_then(["h2", "h3", "h4"], [["h2", "h4"], ["h1", "h3"], ["h2", "h4"]])
GOALS = ["g1", "g2", "g3", "g4"]
ONE_PASSENGER = "G(!(p1 & p2) & !(p1 & p3) & !(p2 & p3))"
FORMULAS = {
    1: f"({strict_then(['red', 'blue', 'green'])}) & ({strict_then(['black', 'white', 'grey'])})",
    2: f"({strict_then(['red', 'blue', 'green', 'pink'])})& ({strict_then(['black', 'white', 'grey', 'yellow'])})",
    3: TASK3,
    4: f"({TASK3}) | ({TASK4})",
    5: f"{then(GOALS)} & G(!wall)",
    6: f"({then(GOALS)} | {then(GOALS[::-1])}) & G(!wall)",
    7: f"F({' | '.join(f'(p{i} & X(p{i} & g))' for i in (1, 2, 3))}) & {ONE_PASSENGER}",
    8: f"F({' | '.join(f'(p{i} & X(p{i} & g1))' for i in (1, 2))}) & F(p3 & X(p3 & g2)) & {ONE_PASSENGER}",
}


def task_table(number: int) -> dict[str, Any]:
    return tomllib.loads(resources.files("t4nmtd_dist").joinpath("tasks", f"task{number}.toml").read_text())


def fake_mona(folder: Path, script: str) -> None:
    program = folder / "mona"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)


@pytest.mark.parametrize("translator", TRANSLATORS)
@pytest.mark.parametrize("number", SIZES)
def test_task_automaton_has_the_published_size(number: int, translator: Translator) -> None:
    task = task_table(number)
    started = time.perf_counter()
    dfa = translate(task["formula"], propositions=task["propositions"], translator=translator)
    assert time.perf_counter() - started < 5
    assert (dfa.states, len(dfa.edges)) == SIZES[number]


@needs_mona
@pytest.mark.parametrize("number", SIZES)
def test_both_translators_agree_on_the_tasks(number: int) -> None:
    text = task_table(number)["formula"]
    assert translate(text, translator="mona") == translate(text, translator="python")


@pytest.mark.parametrize("number", SIZES)
def test_task_file_writes_out_what_the_macros_build(number: int) -> None:
    task = task_table(number)
    assert parse(task["formula"], task["propositions"]) == parse(FORMULAS[number])
    assert task["name"] == f"task{number}"
    assert {name for group in task["exclusive"] for name in group} <= set(task["propositions"])
    assert set(task["environment"]) == {"id", "horizon", "options"}


def test_right_and_wrong_colour_together_count_as_right() -> None:
    dfa = translate(strict_then(["red", "blue"]), translator="python")
    assert dfa.accepts([{"red", "blue"}, set(), {"blue", "red"}])
    assert not dfa.accepts([{"red"}, {"red"}, {"blue"}])
    assert dfa.step(0, {"blue"}) in dfa.error


def test_then_forgives_what_happens_in_between() -> None:
    dfa = translate(then(["a", "b"]), translator="python")
    assert dfa.accepts([{"b"}, {"a"}, {"a"}, set(), {"b"}])
    assert not dfa.accepts([{"a", "b"}])


def test_macros_refuse_what_makes_no_chain() -> None:
    with pytest.raises(ValueError, match="at least one goal"):
        then([])
    with pytest.raises(ValueError, match="one collection of watched"):
        strict_then(["a", "b"], [["a"]])


@pytest.mark.parametrize(
    ("text", "place", "said"),
    [
        ("", "line 1, column 1:\n  \n  ^", "found the end"),
        ("a &", "line 1, column 4:\n  a &\n     ^", "found the end"),
        ("F(a", "line 1, column 4:\n  F(a\n     ^", "is a bracket not closed?"),
        ("a b", "line 1, column 3:\n  a b\n    ^", "expected a binary operator"),
        ("a &\n\tF(b)) | c", "line 2, column 6:\n  \tF(b)) | c\n  \t    ^", "found ')'"),
        ("G Fa", "line 1, column 3:\n  G Fa\n    ^", "a space or bracket"),
        ("F Red", "line 1, column 3:\n  F Red\n    ^", "lower case"),
        ("F lastly", "line 1, column 7:\n  F lastly\n        ^", "must not begin with last"),
        ("a & $", "line 1, column 5:\n  a & $\n      ^", "found '$'"),
    ],
)
def test_syntax_error_shows_its_position(text: str, place: str, said: str) -> None:
    with pytest.raises(FormulaError) as caught:
        translate(text)
    assert str(caught.value).startswith("syntax error")
    assert str(caught.value).endswith(place)
    assert said in str(caught.value)


def test_unknown_proposition_is_named_with_the_nearest_and_the_declared() -> None:
    with pytest.raises(FormulaError) as caught:
        translate("F reddish | F(red &\n X rde)", propositions=["red", "blue", "reddish"])
    assert str(caught.value).splitlines() == [
        "unknown proposition 'rde': did you mean 'red'? declared: red, blue, reddish",
        "line 2, column 4:",
        "   X rde)",
        "     ^",
    ]


@pytest.mark.parametrize("translator", TRANSLATORS)
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("F(a) & G(!a)", "unsatisfiable"),
        ("X(last) & last", "unsatisfiable"),
        ("false", "unsatisfiable"),
        ("a | !a", "valid"),
        ("WX(true)", "valid"),
        ("true", "valid"),
    ],
)
def test_formula_that_makes_no_task_is_refused(text: str, said: str, translator: Translator) -> None:
    with pytest.raises(FormulaError, match=said):
        translate(text, translator=translator)


@pytest.mark.parametrize("translator", TRANSLATORS)
def test_formula_without_propositions_has_one_letter(translator: Translator) -> None:
    dfa = translate("X X true", translator=translator)
    assert dfa.propositions == ()
    assert dfa.delta.tolist() == [[1], [2], [3], [3]]
    assert dfa.accepting == {3}


@pytest.mark.parametrize("translator", TRANSLATORS)
def test_sixteen_propositions_are_the_limit(translator: Translator) -> None:
    names = [f"p{i}" for i in range(17)]
    with pytest.raises(FormulaError, match="17 propositions; expected at most 16"):
        translate(f"F({' & '.join(names)})", translator=translator)
    dfa = translate(f"F({' & '.join(names[:16])})", translator=translator)
    assert dfa.states == 2
    assert dfa.accepts([set(), set(names[:16])])


def test_propositions_are_those_used_even_where_they_do_not_matter() -> None:
    assert translate("F(b) & (a | !a)", propositions=["c", "b", "a"]).propositions == ("a", "b")


@needs_mona
def test_names_that_are_words_of_mona_do_no_harm() -> None:
    words = ["in", "all", "all1", "ex2", "macro", "var2", "max", "where", "v_1", "p", "empty", "p0", "p1"]
    assert translate(then(words), translator="mona") == translate(then(words), translator="python")


def test_mona_program_names_propositions_by_number() -> None:
    assert "var2 P1, P0;" in mona_program(parse("X(zeta) U alpha"), ["alpha", "zeta"])


@pytest.mark.parametrize("translator", TRANSLATORS)
def test_time_limit_ends_an_exponential_translation(translator: Translator) -> None:
    text = f"F(a & {'X(' * 25}b{')' * 25})"
    started = time.perf_counter()
    with pytest.raises(TranslationError, match="not translated within"):
        translate(text, translator=translator, time_limit=0.3)
    assert time.perf_counter() - started < 3


def test_deep_nesting_is_an_error_not_a_crash() -> None:
    assert translate(f"{'X(' * 100}b{')' * 100}", translator="python").states == 103
    with pytest.raises(FormulaError, match="nested too deeply"):
        translate(f"{'X(' * 2000}b{')' * 2000}")


def test_too_large_a_table_is_refused() -> None:
    check_size(512, 16)
    with pytest.raises(TranslationError, match="at most 33554432 entries"):
        check_size(513, 16)


@pytest.mark.parametrize("limit", [0.0, -1.0, float("nan"), float("inf")])
def test_time_limit_must_be_a_positive_number(limit: float) -> None:
    with pytest.raises(ConfigError, match="expected a positive number of seconds"):
        translate("F a", time_limit=limit)


def test_unknown_translator_is_refused() -> None:
    with pytest.raises(ConfigError, match="expected one of auto, mona, python, got 'spot'"):
        translate("F a", translator="spot")  # type: ignore[arg-type]


def test_without_mona_auto_uses_python_and_mona_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert translate("F a") == translate("F a", translator="python")
    with pytest.raises(TranslationError, match=r"package `mona`.*--translator python"):
        translate("F a", translator="mona")


def test_slow_mona_is_ended_with_its_children(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_mona(tmp_path, f"echo $$ > {tmp_path}/pid\nsleep 600 &\nwait")
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    started = time.perf_counter()
    with pytest.raises(TranslationError, match="not translated within"):
        translate("F a", translator="mona", time_limit=0.5)
    assert time.perf_counter() - started < 5
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("echo out of memory; exit 3", "mona ended with code 3: out of memory"),
        ("echo hello", "expected an automaton from mona, got: hello"),
    ],
)
def test_broken_mona_is_reported(script: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_mona(tmp_path, script)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    with pytest.raises(TranslationError, match=said):
        translate("F a", translator="mona")


def test_table_of_mona_is_read_by_variable_name() -> None:
    output = (
        "\nDFA for formula with free variables: P1 P0 \nInitial state: 0\nAccepting states: 2 \n"
        "Rejecting states: 0 1 \n\nAutomaton has 3 states and 4 BDD-nodes\nTransitions:\n"
        "State 0: XX -> state 1\nState 1: 0X -> state 1\nState 1: 10 -> state 2\nState 1: 11 -> state 1\n"
        "State 2: XX -> state 2\n"
    )
    automaton = read_table(output, 2)
    assert automaton.delta.tolist() == [[1] * 4, [1, 1, 2, 1], [2] * 4]
    assert automaton.accepting.tolist() == [False, False, True]
    assert automaton.initial == 1
    with pytest.raises(TranslationError, match="without a target"):
        read_table(output.replace("State 1: 0X -> state 1\n", ""), 2)


@needs_mona
def test_concurrent_translations_do_not_share_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_mona(tmp_path, f'for file; do :; done\necho "$file" >> {tmp_path}/files\nexec {shutil.which("mona")} "$@"')
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    texts = [f"F(a & X(F({name})))" for name in "bcdefghi"]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda text: translate(text, translator="mona"), texts))
    assert found == [translate(text, translator="python") for text in texts]
    files = (tmp_path / "files").read_text().split()
    assert len(set(files)) == len(texts)
    assert not any(Path(file).exists() for file in files)


def test_step_takes_under_two_microseconds() -> None:
    dfa = translate(task_table(8)["formula"], translator="python")
    labels = frozenset({"p1", "g1"})
    fastest = min(timeit.repeat(lambda: dfa.step(0, labels), number=10_000, repeat=10)) / 10_000
    assert fastest < 2e-6


@pytest.mark.command
def test_import_of_the_translator_is_cheap() -> None:
    code = "import sys, t4nmtd_dist.automata.translate; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"sympy", "lark", "ltlf2dfa", "torch"} & set(loaded)
