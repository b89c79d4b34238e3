"""The inspect page, its JSON and its picture."""

from __future__ import annotations

import dataclasses
import io
import json
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from t4nmtd_dist.automata.drawing import draw_svg
from t4nmtd_dist.automata.translate import translate
from t4nmtd_dist.cli.commands import Inspect
from t4nmtd_dist.cli.inspect import formula_task, run_inspect
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.method.compiled import compile_task
from t4nmtd_dist.method.decomposition import decompose
from t4nmtd_dist.tasks import load_task

SVG = "{http://www.w3.org/2000/svg}"
BOTH = "F(a & X(F b)) & G(!(a & c))"


def inspect(formula: str, width: int = 80, *, svg: Path | None = None, as_json: bool = False, **changes: Any) -> str:
    task = formula_task(formula, ['acceptance="first"'])
    task = dataclasses.replace(task, **({"name": "mine", "title": "first a, then b"} | changes))
    console = Console(file=io.StringIO(), width=width, color_system=None)
    run_inspect(task, console=console, translator="python", as_json=as_json, svg=svg)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_json_has_the_documented_keys() -> None:
    found = json.loads(inspect(BOTH, as_json=True))
    assert set(found) == {
        "acceptance", "propositions", "states", "transitions", "initial", "accepting", "error", "edges", "dist",
        "potential", "subtasks",
    }  # fmt: skip
    assert (found["states"], found["transitions"]) == (4, len(found["edges"]))
    assert found["initial"] == 0
    (error,), (accepting,) = found["error"], found["accepting"]
    assert found["dist"][str(error)] is None
    assert (found["dist"][str(accepting)], found["potential"][str(accepting)]) == (0, 100)
    assert list(found["subtasks"]) == ["a", "b"]
    assert found["subtasks"]["a"][0][0] == 0


def test_a_random_decomposition_is_that_of_the_seeds_run(capsys: pytest.CaptureFixture[str]) -> None:
    flags = ["decomposition.mode=random"]
    config = load_task("task4", flags=flags)
    shown = []
    for seed in (0, 3):
        assert Inspect("task4", seed=seed, set=flags, as_json=True, translator="python").run() == 0
        shown.append(json.loads(capsys.readouterr().out)["subtasks"])
        assert shown[-1] == compile_task(config, translator="python", seed=seed).decomposition.to_json()
    assert shown[0] != shown[1]


def test_json_guards_are_lists_of_cubes_of_literals() -> None:
    found = json.loads(inspect("F a", as_json=True))
    guards = {(edge["source"], edge["target"]): edge["guard"] for edge in found["edges"]}
    assert guards == {(0, 0): [["~a"]], (0, 1): [["a"]], (1, 1): [[]]}


def test_json_is_not_wrapped_at_the_width_of_the_terminal() -> None:
    name = "a_very_long_name_of_a_proposition"
    assert json.loads(inspect(f"F {name}", as_json=True, width=20))["propositions"] == [name]


def test_reduced_counts_appear_only_where_exclusive_propositions_change_them() -> None:
    exclusive = (("a", "b"),)
    found = json.loads(inspect("F(a & b) | F c", as_json=True, exclusive=exclusive))
    assert "reduced" not in found
    found = json.loads(inspect("(!b U (a & X(F c))) | F(a & b)", as_json=True, exclusive=exclusive))
    assert found["reduced"]["states"] <= found["states"]
    assert found["reduced"]["transitions"] < found["transitions"]


@pytest.mark.parametrize("width", [80, 100])
def test_the_page_shows_states_guards_and_targets_within_the_width(width: int) -> None:
    page = inspect(BOTH, width=width)
    assert all(len(line) <= width for line in page.splitlines())
    for part in (
        "mine: first a, then b",
        BOTH,
        "4 states",
        "initial",
        "accepting",
        "error",
        "a & ~c",
        "0 → {",
    ):
        assert part in page


def test_a_formula_in_brackets_is_printed_as_it_is() -> None:
    assert "[red]" in inspect("F a", title="[red] is no markup")


def test_the_picture_is_written_and_shows_every_state_and_guard(tmp_path: Path) -> None:
    file = tmp_path / "automaton.svg"
    assert str(file.name) in inspect(BOTH, svg=file, width=200)
    root = ET.fromstring(file.read_text("utf-8"))
    texts = {element.text for element in root.iter(f"{SVG}text")}
    titles = [element.text or "" for element in root.iter(f"{SVG}title")]
    dfa = translate(BOTH, translator="python")
    assert {str(q) for q in range(dfa.states) if q not in dfa.error} <= texts
    assert {"a (1)", "b (1)"} <= texts
    for q, target in dfa.edges:
        assert q in dfa.error or any(title.startswith(f"{q} → {target}:") for title in titles)


def test_transitions_of_two_sub_tasks_are_striped_and_colour_names_keep_their_colour() -> None:
    dfa = translate("F red & F blue", translator="python")
    picture = draw_svg(dfa, decompose(dfa).subtasks)
    assert "#d62828" in picture
    assert 'stroke-dasharray="9 9"' in picture


def test_a_picture_takes_its_colours_from_the_caller() -> None:
    dfa = translate("F red & F blue", translator="python")
    picture = draw_svg(
        dfa, {"first": [(dfa.initial, target) for q, target in dfa.edges if q == dfa.initial]}, {"first": "#123456"}
    )
    assert "#123456" in picture
    assert "#d62828" not in picture


def test_a_picture_file_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot write"):
        inspect("F a", svg=tmp_path / "missing" / "automaton.svg")
