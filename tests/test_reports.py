"""What reports say of a run: both counts of interactions, the threshold, and the policy that is kept."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path
from typing import Any

import msgspec
import pytest
import tyro
from processes import Processes
from rich.console import Console
from small_tasks import own_task
from test_coordinator_evaluations import Evaluated
from test_evaluation_modes import CORRIDOR

from coordinator.events import Interrupted
from coordinator.snapshot import dashboard_state, status, summary
from coordinator.ui.dashboard import plain_line, render
from coordinator.ui.dashboard import summary as dashboard_summary
from t4nmtd_dist.cli import status as status_command
from t4nmtd_dist.cli.commands import Command
from t4nmtd_dist.runs.report import outcome_text

SOLVED = "solved after 300 interactions (the first of 5 evaluations in a row), 700 in all"


def solved(*flags: str, mode: str = "greedy") -> Evaluated:
    talk = Evaluated("evaluation.actions=best", *flags)
    for success in (0.2, 0.5, 1.0, 1.0, 1.0, 1.0, 1.0):
        talk.evaluate(success, actions=mode)
    return talk


def stopped(*evaluations: tuple[float, str]) -> Evaluated:
    talk = Evaluated("evaluation.actions=best")
    for success, mode in evaluations:
        talk.evaluate(success, actions=mode)
    talk.state.handle(Interrupted(talk.now, "enough"))
    return talk


def drawn(drawable: Any, width: int = 160) -> str:
    console = Console(file=io.StringIO(), width=width, force_terminal=False)
    console.print(drawable)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_a_solved_run_says_when_its_row_began_and_what_it_took_in_all() -> None:
    told = outcome_text(summary(solved().state), Path("run"))
    assert told == f"{SOLVED}; best evaluation 100% with greedy actions at 700 interactions, policy in run/policy"


def test_an_unsolved_run_says_how_good_its_best_evaluation_was() -> None:
    told = outcome_text(summary(stopped((0.75, "sampled"), (0.5, "greedy")).state), Path("run"))
    assert told == (
        "stopped after 200 interactions; best evaluation 75% with sampled actions at 100 interactions, "
        "policy in run/policy"
    )
    assert outcome_text(summary(stopped().state), Path("run")) == (
        "stopped after 0 interactions; no evaluation, so there is no policy"
    )


def test_a_summary_of_an_older_run_can_be_reported() -> None:
    older = summary(solved().state)
    for key in ("policy", "in_a_row"):
        del older[key]
    assert outcome_text(older, Path("run")).startswith("solved after 300 interactions, 700 in all")


def test_the_status_page_has_the_same_words(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def page(talk: Evaluated) -> str:
        monkeypatch.setattr(status_command, "ask_status", lambda *_: status(talk.state, 0.0))
        assert status_command.show_status("tcp://127.0.0.1:1", None, 1.0, check=False, as_json=False) == 0
        return capsys.readouterr().out

    assert SOLVED in page(solved())
    assert "best evaluation 100% with sampled actions" in page(solved(mode="sampled"))
    assert "best evaluation 75% with sampled actions at 100 inter" in page(stopped((0.75, "sampled"), (0.5, "greedy")))
    assert "100% successful in a row: 5 of 5" in page(solved())
    assert "at least 90% successful in a row: 5 of 5" in page(solved("evaluation.success=0.9"))
    assert "at least 99.5% successful in a row" in page(solved("evaluation.success=0.995"))
    assert "perfect" not in page(solved("evaluation.success=0.9"))


@pytest.mark.parametrize("size", [(60, 12), (80, 24), (160, 50)])
def test_the_dashboard_names_the_threshold_and_the_sampled_mode(size: tuple[int, int]) -> None:
    width, height = size
    talk = Evaluated("evaluation.actions=best", "evaluation.success=0.9")
    talk.evaluate(0.95, actions="sampled", other_success_rate=0.7)
    state = dashboard_state(talk.state)
    page = drawn(render(state, width=width, height=height), width)
    assert re.search(r"1/5 in a row at 90%", page)
    assert re.search(r"95% sampled", page)
    assert "1/5 in a row at 90%" in plain_line(state)
    assert "95% sampled" in plain_line(state)
    talk = Evaluated()
    talk.evaluate(1.0)
    usual = dashboard_state(talk.state)
    assert "1/5 in a row |" in plain_line(usual)
    assert "sampled" not in plain_line(usual) + drawn(render(usual, width=width, height=height), width)


def test_what_the_dashboard_leaves_behind_has_both_counts() -> None:
    assert SOLVED in drawn(dashboard_summary(dashboard_state(solved().state), width=160)).replace("\n", " ")
    assert "solved after 300, 700 in all" in plain_line(dashboard_state(solved().state))
    unsolved = dashboard_state(stopped((0.75, "sampled"), (0.5, "greedy")).state)
    assert "best evaluation 75%" in drawn(dashboard_summary(unsolved, width=160))
    assert "best 75%" in plain_line(unsolved)


def test_states_of_an_older_coordinator_are_drawn() -> None:
    """The new fields have defaults."""
    state = msgspec.to_builtins(dashboard_state(solved().state))
    for key in ("success_needed", "solved_at", "policy"):
        del state[key]
    older = msgspec.convert(state, type(dashboard_state(solved().state)))
    assert "5/5 in a row" in plain_line(older)
    assert drawn(dashboard_summary(older, width=100))


# From the command line


def run_of(commands: Processes, *flags: str) -> str:
    """The only line that a serial training of the corridor prints."""
    settings = [part for flag in flags for part in ("--set", flag)]
    task = own_task(commands.folder, CORRIDOR)
    arguments = ["--serial", "--task", str(task), "--run-dir", str(commands.folder / "run"), *settings]
    started = commands.start("t4nmtd", "train", *arguments)
    assert started.wait(60) in (0, 3), started.story()
    (line,) = started.out.splitlines()
    return line


def test_training_ends_with_both_counts(commands: Processes) -> None:
    line, run = run_of(commands), commands.folder / "run"
    told = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    assert told["solved"]
    first, total = told["interactions"], told["interactions_total"]
    assert first < total
    assert f"solved after {first:,} interactions (the first of 5 evaluations in a row), {total:,} in all" in line
    assert f"policy in {run / 'policy'}" in line


def test_evaluate_plays_as_the_export_says_or_as_it_is_told(
    commands: Processes, capsys: pytest.CaptureFixture[str]
) -> None:
    run_of(commands, "evaluation.actions=sampled", "max_interactions=300")

    def evaluated(*arguments: str) -> tuple[dict[str, Any], str]:
        told = []
        for form in (["--json"], []):
            command = ["evaluate", str(commands.folder / "run"), "--episodes", "10", *arguments, *form]
            assert tyro.cli(Command, args=command).run() == 0  # type: ignore[arg-type]
            told.append(capsys.readouterr().out)
        return json.loads(told[0]), told[1]

    as_exported, sentence = evaluated()
    assert as_exported["actions"] == "sampled"
    assert "with sampled actions" in sentence
    assert evaluated()[0] == as_exported, "the seed decides what is sampled"
    greedy, sentence = evaluated("--actions", "greedy")
    assert greedy["actions"] == "greedy"
    assert "with greedy actions" in sentence
