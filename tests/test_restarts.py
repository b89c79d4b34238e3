"""Workers that end with code 2: told of, started again a few times, and given up while the others go on."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from t4nmtd_dist.core.errors import BROKEN_ENVIRONMENT, RunError
from t4nmtd_dist.launch import local
from t4nmtd_dist.launch.local import LocalProcesses

DEADLINE_S = 30.0
SLEEPS = "import time; time.sleep(60)"
REFUSES = "import sys; print('t4nmtd-worker: mend me', file=sys.stderr); sys.exit(2)"
CRASHES = "import os; os.abort()"
DEAF = (
    "import pathlib, signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); pathlib.Path({mark!r}).touch(); "
    "time.sleep(60)"
)
REFUSES_ONCE = (
    "import pathlib, sys, time; mark = pathlib.Path({mark!r}); known = mark.exists(); mark.touch(); "
    "time.sleep(60) if known else sys.exit(2)"
)


class Launcher(LocalProcesses):
    """Remembers what it reports."""

    def __init__(self, folder: Path) -> None:
        self.told: list[str] = []
        super().__init__(folder, lambda text, _: self.told.append(text))


@pytest.fixture
def processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Launcher]:
    """A launcher whose workers are small programs, and whose coordinator sleeps."""
    (tmp_path / "logs").mkdir()
    monkeypatch.setattr(local, "RESTART_PAUSE_S", 0.01)
    monkeypatch.setattr(local, "role", lambda program: [sys.executable, "-c"])
    launcher = Launcher(tmp_path)
    launcher._coordinator = subprocess.Popen([sys.executable, "-c", SLEEPS])
    yield launcher
    launcher.end()


def told(launcher: Launcher) -> list[str]:
    return launcher.told


def check_until(launcher: Launcher, lines: int) -> None:
    """Check until so many lines were told."""
    deadline = time.monotonic() + DEADLINE_S
    while len(told(launcher)) < lines:
        assert launcher.check()
        assert time.monotonic() < deadline, told(launcher)
        time.sleep(0.01)


def test_a_worker_that_refuses_to_work_is_given_up_and_the_others_go_on(processes: Launcher) -> None:
    processes.start_worker("good", [SLEEPS])
    processes.start_worker("bad", [REFUSES])
    good = processes.processes()["good"]
    check_until(processes, local.MOST_REFUSALS)
    *before, last = told(processes)
    assert all("worker bad ended with code 2 and is started again" in line for line in before)
    assert "worker bad ended with code 2 and is not started again" in last
    assert all(line.endswith("t4nmtd-worker: mend me") for line in told(processes))
    for _ in range(20):
        assert processes.check()
    assert processes.processes()["good"] == good
    assert len(told(processes)) == local.MOST_REFUSALS


def test_a_worker_that_refuses_once_is_started_again(processes: Launcher, tmp_path: Path) -> None:
    processes.start_worker("good", [SLEEPS])
    processes.start_worker("once", [REFUSES_ONCE.format(mark=str(tmp_path / "mark"))])
    first = processes.processes()["once"]
    check_until(processes, 1)
    deadline = time.monotonic() + DEADLINE_S
    while processes.processes()["once"] == first:
        assert processes.check()
        assert time.monotonic() < deadline
    assert len(told(processes)) == 1


def test_learners_that_all_refuse_at_the_start_end_the_training_with_their_words(processes: Launcher) -> None:
    for name in ("one", "two"):
        processes.start_worker(name, [REFUSES])
    processes.start_worker("evaluator", [SLEEPS, "--evaluate"])
    with pytest.raises(RunError, match=r"(?s)ended with code 2.*t4nmtd-worker: mend me"):
        check_until(processes, 1000)


def test_the_last_learner_that_is_given_up_ends_the_training(
    processes: Launcher, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local, "MOST_RESTARTS", 2)
    processes.start_worker("crashing", [CRASHES])
    processes.start_worker("refusing", [REFUSES])
    processes.start_worker("evaluator", [SLEEPS, "--evaluate"])
    with pytest.raises(RunError, match="was killed by SIGABRT"):
        check_until(processes, 1000)


def test_an_environment_that_fails_again_and_again_ends_the_training(processes: Launcher) -> None:
    processes.start_worker("waiting", [SLEEPS])
    processes.start_worker(
        "broken", [f"import sys; print('my.py, line 7', file=sys.stderr); sys.exit({BROKEN_ENVIRONMENT})"]
    )
    with pytest.raises(RunError, match=r"(?s)worker broken ended with code 4 and is not started again.*my.py, line 7"):
        check_until(processes, 1000)
    assert len(told(processes)) == local.MOST_REFUSALS


def test_an_evaluator_that_refuses_ends_no_training(processes: Launcher) -> None:
    processes.start_worker("good", [SLEEPS])
    processes.start_worker("evaluator", [REFUSES, "--evaluate"])
    check_until(processes, local.MOST_REFUSALS)
    assert processes.check()


def test_the_last_words_of_a_worker_are_short_and_a_log_that_is_gone_has_none(tmp_path: Path) -> None:
    log = tmp_path / "w.log"
    assert local._tail(log) == ""
    log.write_text("x" * 50_000 + "\nlast words\n", encoding="utf-8")
    first, last = local._tail(log).splitlines()
    assert (len(first), first[-3:], last) == (local.LONGEST_LINE, "...", "last words")


def test_a_worker_that_does_not_end_in_time_is_killed_and_told_of(
    processes: Launcher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local, "END_DEADLINE_S", 0.5)
    mark = tmp_path / "deaf"
    processes.start_worker("deaf", [DEAF.format(mark=str(mark))])
    processes.start_worker("good", [SLEEPS])
    deadline = time.monotonic() + DEADLINE_S
    while not mark.exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    processes.end()
    (line,) = told(processes)
    assert line.startswith("worker deaf did not end within")
    assert processes._children["deaf"].process.returncode == -signal.SIGKILL


def test_a_worker_whose_log_was_deleted_is_started_again(processes: Launcher, tmp_path: Path) -> None:
    processes.start_worker("p1", [CRASHES])
    child = processes._children["p1"]
    child.process.wait(DEADLINE_S)
    child.log.unlink()
    deadline = time.monotonic() + DEADLINE_S
    while child.restarts == 0:
        assert processes.check()
        assert time.monotonic() < deadline
    assert child.log.exists()
