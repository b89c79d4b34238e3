"""``t4nmtd check`` suggests exclusive groups from what it saw."""

from __future__ import annotations

import itertools
import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_tasks import own_task

from t4nmtd_dist.cli.check import check
from t4nmtd_dist.environments.exclusive import MIN_TRUE, never_together

HERE = Path(__file__).parent

CORRIDOR = f"""
name = "corridor"
formula = "F left & F right"
propositions = ["left", "right", "again"]
[environment]
id = "own_environments:Corridor"
path = "{HERE}"
horizon = 30
"""


def found(folder: Path, capsys: pytest.CaptureFixture[str], text: str) -> dict[str, Any]:
    assert check(str(own_task(folder, text)), steps=600, seed=0, flags=(), as_json=True) == 0
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    return result


def test_propositions_never_seen_together_are_suggested(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = found(tmp_path, capsys, CORRIDOR)
    (suggestion,) = report["exclusive_suggestions"]
    assert suggestion["group"] == ["left", "right"]
    assert suggestion["true_steps"] == {
        name: round(report["labels"][name] * report["steps"]) for name in ("left", "right")
    }
    counts = list(suggestion["true_steps"].values())
    assert suggestion["expected_together"] == pytest.approx(counts[0] * counts[1] / 600, abs=0.01)
    assert min(suggestion["true_steps"].values()) >= MIN_TRUE
    assert suggestion["states"] == suggestion["states_before"] == 4
    assert (suggestion["transitions"], suggestion["transitions_before"]) == (8, 9)
    assert report["exclusive_violations"] == report["problems"] == []


def test_the_page_says_that_it_is_a_suggestion(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert check(str(own_task(tmp_path, CORRIDOR)), steps=600, seed=0, flags=(), as_json=False) == 0
    page = " ".join(capsys.readouterr().out.split())
    assert "suggestion: left and right were never true together on 600 random steps (left" in page
    assert 'if they cannot be, exclusive = [["left", "right"]] makes the automaton smaller' in page
    assert "(4 -> 4 states, 9 -> 8 transitions)" in page


def test_a_suggestion_that_may_change_the_acceptance_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = CORRIDOR.replace("F left & F right", "F left & F right & G(!(left & right))")
    check(str(own_task(tmp_path, text)), steps=600, seed=0, flags=(), as_json=False)
    page = " ".join(capsys.readouterr().out.split())
    said = "with it, acceptance = auto may end episodes at the first accepting state; set acceptance to keep it"
    assert said in page
    check(str(own_task(tmp_path, CORRIDOR)), steps=600, seed=0, flags=(), as_json=False)
    assert said not in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("[environment]", 'exclusive = [["left", "right"]]\n[environment]'),  # declared already
        ("[environment]", 'exclusive = [["again", "left", "right"]]\n[environment]'),  # within a declared group
        ("F left & F right", "F(left & X(F(left)))"),  # not both in the formula
        ("F left & F right", "F(left | right)"),  # nothing would become smaller
    ],
)
def test_no_suggestion_where_it_would_change_nothing(
    old: str, new: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    check(str(own_task(tmp_path, CORRIDOR.replace(old, new))), steps=600, seed=0, flags=(), as_json=True)
    assert json.loads(capsys.readouterr().out)["exclusive_suggestions"] == []


def test_no_suggestion_that_would_make_the_task_impossible(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = found(tmp_path, capsys, CORRIDOR.replace("F left & F right", "F(left & right)"))
    assert report["exclusive_suggestions"] == []


LETTERS = st.lists(st.frozensets(st.sampled_from("abcde")), max_size=60)


@settings(max_examples=200)
@given(LETTERS, st.integers(1, 4))
def test_groups_are_maximal_and_were_never_true_together(symbols: list[frozenset[str]], least: int) -> None:
    seen = Counter(symbols)
    true = Counter(name for symbol in symbols for name in symbol)
    groups = never_together("abcde", seen, least=least)
    frequent = {name for name in "abcde" if true[name] >= least}

    def apart(names: tuple[str, ...]) -> bool:
        return not any(len(symbol & set(names)) > 1 for symbol in symbols)

    expected = {
        names
        for size in range(2, 6)
        for names in itertools.combinations(sorted(frequent), size)
        if apart(names) and not any(apart(tuple({*names, other})) for other in frequent - set(names))
    }
    assert set(groups) == expected
    assert len(groups) == len(expected)
