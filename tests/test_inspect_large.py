"""``t4nmtd inspect`` of large automata: a summary, and an answer or a refusal in time."""

from __future__ import annotations

import itertools
import json
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from t4nmtd_dist.automata import deadline
from t4nmtd_dist.cli.commands import Inspect
from t4nmtd_dist.core.config import task_config
from t4nmtd_dist.core.errors import ConfigError, T4NMTDError, TranslationError
from t4nmtd_dist.method.compiled import compile_task
from t4nmtd_dist.tasks import load_task
from t4nmtd_dist.wire.task_size import check_task_size

TEN = "abcdefghij"


def unordered(goals: str) -> str:
    return " & ".join(f"F {goal}" for goal in goals)


def inspected(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, **options: Any) -> str:
    monkeypatch.setenv("COLUMNS", "80")
    assert Inspect(**options).run() == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("goals", [TEN[:6], TEN[:8]])
@pytest.mark.slow
def test_the_summary_of_a_large_automaton_fits_on_a_screen(
    goals: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    exclusive = [f"exclusive={json.dumps([list(goals)])}", "acceptance=first"]
    formula = f"({unordered(goals)}) & G(!wall)"
    page = inspected(capsys, monkeypatch, formula=formula, summary=True, set=exclusive)
    lines = page.splitlines()
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 80
    states = 2 ** len(goals)
    assert f"{states + 1} states" in page
    assert f"farthest from acceptance: {len(goals)} transitions" in page
    (line,) = (line for line in lines if line.split()[:1] == ["b"])
    assert line.split()[1] == str(2 ** (len(goals) - 1))
    assert line.endswith(f"1 to {len(goals)}")
    assert "0 → {" not in page


def test_the_summary_of_many_sub_tasks_and_distances_still_fits(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [f"a_long_name_{i:02}" for i in range(13)]
    chain = ""
    for name in reversed(names):
        chain = f"F({name} & X({chain}))" if chain else f"F({name})"
    page = inspected(capsys, monkeypatch, formula=chain, summary=True)
    assert len(page.splitlines()) <= 40
    assert max(map(len, page.splitlines())) <= 80
    assert "more" in page


def test_a_small_task_is_summarised_only_when_asked(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "Q_target" in inspected(capsys, monkeypatch, task="task7")
    page = inspected(capsys, monkeypatch, task="task7", summary=True)
    assert "Q_target" not in page
    assert "6 states" in page


def test_a_large_automaton_is_summarised_unless_the_full_page_is_asked_for(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    page = inspected(capsys, monkeypatch, formula=unordered(TEN[:6]))
    assert "Q_target" not in page
    assert "--full" in page
    page = inspected(capsys, monkeypatch, formula=unordered(TEN[:6]), full=True)
    assert "Q_target" in page


@pytest.mark.parametrize("options", [{"full": True}, {"as_json": True}])
def test_a_summary_with_more_is_a_contradiction(options: dict[str, bool]) -> None:
    with pytest.raises(ConfigError, match="--summary"):
        Inspect(task="task7", summary=True, **options).run()


@pytest.mark.parametrize("translator", ["mona", "python"])
@pytest.mark.slow
def test_ten_unordered_goals_are_answered_in_time(
    translator: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    began = time.process_time()
    page = inspected(capsys, monkeypatch, formula=unordered(TEN), translator=translator)
    assert "1024 states, 59049 transitions" in page
    assert time.process_time() - began < 20
    assert len(page.splitlines()) <= 40


@pytest.mark.slow
def test_ten_unordered_goals_compile() -> None:
    data = load_task("task7").to_dict() | {"formula": unordered(TEN), "propositions": list(TEN)}
    compiled = compile_task(task_config(data))
    assert compiled.decomposition.pids == tuple(TEN)
    assert len(compiled.dist) == 1024


def refusal(formula: str, *flags: str) -> T4NMTDError:
    began = time.monotonic()
    with pytest.raises((ConfigError, TranslationError)) as caught:
        Inspect(formula=formula, translator="python", set=list(flags)).run()
    assert time.monotonic() - began < 60
    return caught.value


@pytest.mark.slow
def test_what_takes_too_long_is_refused_with_the_limit_and_what_to_do() -> None:
    text = str(refusal(unordered(TEN), "decomposition.time_limit=1"))
    assert "not compiled within 1 s" in text or "not translated within 1 s" in text
    assert "decomposition.time_limit" in text


def test_one_deadline_holds_for_every_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a clock that ticks whenever it is read, compiling fails wherever the time is up."""
    data = load_task("task7").to_dict() | {"formula": unordered(TEN[:5]), "propositions": list(TEN[:5])}
    clock = itertools.count()
    monkeypatch.setattr(deadline, "time", SimpleNamespace(monotonic=lambda: next(clock)))

    def compiled_within(ticks: float) -> int:
        data["decomposition"] = {"time_limit": ticks}
        began = next(clock)
        compile_task(task_config(data), translator="python")
        return next(clock) - began

    needed = compiled_within(1e9)
    stages = set()
    for share in range(1, 20):
        with pytest.raises((ConfigError, TranslationError)) as caught:
            compiled_within(needed * share / 20)
        stages.add(str(caught.value).partition("too large for ")[2].partition(".")[0])
    expected = {"the search for simple paths", "dealing its transitions to sub-tasks", "writing down its guards"}
    assert stages >= {"", *expected}


def test_a_task_too_large_for_a_message_to_a_worker_is_refused() -> None:
    data = load_task("task7").to_dict() | {"formula": unordered(TEN[:8]), "propositions": list(TEN[:8])}
    task = compile_task(task_config(data))
    check_task_size(task)
    parts = {"dfa": task.dfa.to_json(), "decomposition": task.decomposition.to_json()}
    size = len(msgspec.msgpack.encode(parts))
    with pytest.raises(ConfigError, match=r"256 states and 6561 transitions, .* train with --serial"):
        check_task_size(task, most=size)


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
@pytest.mark.parametrize(
    ("hidden", "text"),
    [
        ([1] * 200, r"arrays in the message (of a learner|to an evaluator); at most 1024 fit\. .*hidden.*--serial"),
        ([1400, 1400, 1400], r"MiB in the message (of a learner|to an evaluator); at most 32 fit\. .*hidden.*--serial"),
        ([8000, 8000], r"MiB in one array; at most 16 fit\. .*hidden.*--serial"),
    ],
)
def test_networks_too_large_for_a_message_are_refused(algorithm: str, hidden: list[int], text: str) -> None:
    task = compile_task(load_task("task7", flags=[f'learner.algorithm="{algorithm}"', f"learner.hidden={hidden}"]))
    with pytest.raises(ConfigError, match=text):
        check_task_size(task)


def test_a_table_too_large_to_keep_is_refused_at_once() -> None:
    text = str(refusal(unordered("abcdefghijklmno")))
    assert "expected at most 33554432 entries" in text
    assert "fewer propositions" in text


def test_a_picture_too_large_to_draw_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="729 transitions; at most 600 can be drawn"):
        Inspect(formula=unordered(TEN[:6]), svg=tmp_path / "picture.svg").run()
    assert not list(tmp_path.iterdir())


# Settings of a formula, and what was left out


def test_settings_apply_to_a_formula_too(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    formula = "F(red & magenta)"
    found = json.loads(inspected(capsys, monkeypatch, formula=formula, as_json=True))
    assert list(found["subtasks"]) == ["red&magenta"]
    every = inspected(capsys, monkeypatch, formula=formula, as_json=True, set=["decomposition.keep=all"])
    assert list(json.loads(every)["subtasks"]) == ["magenta", "red"]
    with pytest.raises(ConfigError, match=r"unknown key 'decomposition.kep'; did you mean 'decomposition.keep'"):
        Inspect(formula=formula, set=["decomposition.kep=all"]).run()
    reduced = inspected(capsys, monkeypatch, formula="F a & F b", as_json=True, set=['exclusive=[["a", "b"]]'])
    assert json.loads(reduced)["reduced"]["transitions"] == 8


@pytest.mark.parametrize("summary", [True, False])
def test_what_was_left_out_and_merged_is_said(
    summary: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    formula = "G(a -> F b) & F(c & d)"
    page = inspected(capsys, monkeypatch, formula=formula, summary=summary)
    assert "left out: a (no transition of it brings acceptance nearer)" in page
    assert "merged: c&d (equal transitions)" in page
    assert json.loads(inspected(capsys, monkeypatch, formula=formula, as_json=True))["left_out"] == ["a"]
    whole = inspected(capsys, monkeypatch, task="task7", summary=summary)
    assert "left out" not in whole
    assert "merged" not in whole
