"""Launchers: a program is data, and what starts it is one file and one line in the registry."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from pathlib import Path

import pytest

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.core.registry import LAUNCHERS
from t4nmtd_dist.launch.build import build_program
from t4nmtd_dist.launch.command_lines import coordinator_command, worker_command
from t4nmtd_dist.launch.program import Program
from t4nmtd_dist.launch.protocol import BUDGET_SPENT, STOPPED
from t4nmtd_dist.launch.run import launch
from t4nmtd_dist.runs.options import RunOptions
from t4nmtd_dist.runs.planning import plan_run

WAIT_S = 60.0
SHORT = ("evaluation.every=1000", "evaluation.episodes=2")


def program_of(folder: Path, *, serial: bool = False, workers: int | None = None, budget: int = 500) -> Program:
    options = RunOptions(
        task="task7", run_dir=folder / "run", max_interactions=budget, set=list(SHORT), translator="python"
    )
    return build_program(plan_run(options, serial=serial), options, workers=workers)


@pytest.fixture
def shell(monkeypatch: pytest.MonkeyPatch) -> str:
    """A third launcher, added by one line."""
    monkeypatch.setitem(LAUNCHERS.modules, "shell", "shell_launcher")  # type: ignore[arg-type]
    return "shell"


def summary(program: Program) -> dict[str, object]:
    found: dict[str, object] = json.loads((program.directory / "summary.json").read_text(encoding="utf-8"))
    return found


def test_a_program_is_data_and_starts_and_writes_nothing(tmp_path: Path) -> None:
    program = program_of(tmp_path, workers=2)
    assert not (tmp_path / "run").exists()
    assert [role.kind for role in program.roles] == ["coordinator", "learner", "learner", "evaluator"]
    assert sorted(pid for role in program.workers for pid in role.pids) == ["g", "p1", "p2", "p3"]
    assert len({role.name for role in program.roles}) == 4


def test_the_command_lines_of_a_program_say_all_that_its_options_say(tmp_path: Path) -> None:
    program = program_of(tmp_path)
    command = " ".join(coordinator_command(program))
    for part in ("--task task7", "--max-interactions 500", f"--set {SHORT[0]}", f"--run-dir {program.directory}"):
        assert part in command
    learner, evaluator = program.workers[0], program.workers[-1]
    told = " ".join(worker_command(program, learner, "tcp://host:1"))
    assert f"--pid {learner.pids[0]}" in told
    assert f"--instance {learner.name}" in told
    assert "--connect tcp://host:1" in told
    assert "--evaluate" in worker_command(program, evaluator, "tcp://host:1")
    assert "--pid" not in worker_command(program, evaluator, "tcp://host:1")


@pytest.mark.process
def test_a_launcher_is_one_file_and_one_line(shell: str, tmp_path: Path) -> None:
    program = program_of(tmp_path, workers=2)
    assert launch(program, shell) == BUDGET_SPENT
    assert summary(program)["outcome"] == "budget spent"
    assert (program.directory / "logs" / "evaluator.code").exists()


def test_the_serial_launcher_goes_the_same_way(tmp_path: Path) -> None:
    program = program_of(tmp_path, serial=True)
    assert launch(program, "serial") == BUDGET_SPENT
    assert summary(program)["outcome"] == "budget spent"


def test_a_serial_run_ends_when_asked_and_leaves_its_signal_handlers_as_they_were(tmp_path: Path) -> None:
    program = program_of(tmp_path, serial=True, budget=10**9)
    before = signal.getsignal(signal.SIGTERM)

    def stop() -> None:
        deadline = time.monotonic() + WAIT_S
        while signal.getsignal(signal.SIGTERM) is before and time.monotonic() < deadline:
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGTERM)

    stopping = threading.Thread(target=stop)
    stopping.start()
    assert launch(program, "serial") == STOPPED
    stopping.join()
    assert signal.getsignal(signal.SIGTERM) is before
    assert summary(program)["outcome"] == "stopped"


def test_an_unknown_launcher_is_refused_before_the_run_directory_is_made(tmp_path: Path) -> None:
    program = program_of(tmp_path)
    with pytest.raises(ConfigError, match=r"unknown launcher 'serail'; did you mean 'serial'"):
        launch(program, "serail")
    assert not program.directory.exists()
