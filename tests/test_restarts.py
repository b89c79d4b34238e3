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
from t4nmtd_dist.launch import local, restarts
from t4nmtd_dist.launch.local import end_processes
from t4nmtd_dist.launch.logs import LONGEST_LINE, tail
from t4nmtd_dist.launch.restarts import RestartedWorkers

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


class Workers(RestartedWorkers):
    """Small programs as workers; remembers what it reports."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.told = folder, list[str]()
        super().__init__(lambda text, _: self.told.append(text))

    def start(self, name: str, program: str, *, learns: bool = True) -> None:
        log = self.folder / f"{name}.log"

        def spawn() -> subprocess.Popen[bytes]:
            with log.open("ab") as file:
                return subprocess.Popen([sys.executable, "-c", program], stdout=file, stderr=file)

        self.add(name, spawn, log, learns=learns)

    def number(self, name: str) -> int:
        return self.workers[name].process.pid


@pytest.fixture
def workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Workers]:
    monkeypatch.setattr(restarts, "RESTART_PAUSE_S", 0.01)
    made = Workers(tmp_path)
    yield made
    for worker in made.workers.values():
        worker.process.kill()
        worker.process.wait()


def check_until(workers: Workers, lines: int) -> None:
    """Check until so many lines were told."""
    deadline = time.monotonic() + DEADLINE_S
    while len(workers.told) < lines:
        workers.check()
        assert time.monotonic() < deadline, workers.told
        time.sleep(0.01)


def test_a_worker_that_refuses_to_work_is_given_up_and_the_others_go_on(workers: Workers) -> None:
    workers.start("good", SLEEPS)
    workers.start("bad", REFUSES)
    good = workers.number("good")
    check_until(workers, restarts.MOST_REFUSALS)
    *before, last = workers.told
    assert all("worker bad ended with code 2 and is started again" in line for line in before)
    assert "worker bad ended with code 2 and is not started again" in last
    assert all(line.endswith("t4nmtd-worker: mend me") for line in workers.told)
    for _ in range(20):
        workers.check()
    assert workers.number("good") == good
    assert len(workers.told) == restarts.MOST_REFUSALS


def test_a_worker_that_refuses_once_is_started_again(workers: Workers, tmp_path: Path) -> None:
    workers.start("good", SLEEPS)
    workers.start("once", REFUSES_ONCE.format(mark=str(tmp_path / "mark")))
    first = workers.number("once")
    check_until(workers, 1)
    deadline = time.monotonic() + DEADLINE_S
    while workers.number("once") == first:
        workers.check()
        assert time.monotonic() < deadline
    assert len(workers.told) == 1


def test_learners_that_all_refuse_at_the_start_end_the_training_with_their_words(workers: Workers) -> None:
    for name in ("one", "two"):
        workers.start(name, REFUSES)
    workers.start("evaluator", SLEEPS, learns=False)
    with pytest.raises(RunError, match=r"(?s)ended with code 2.*t4nmtd-worker: mend me"):
        check_until(workers, 1000)


def test_the_last_learner_that_is_given_up_ends_the_training(workers: Workers, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(restarts, "MOST_RESTARTS", 2)
    workers.start("crashing", CRASHES)
    workers.start("refusing", REFUSES)
    workers.start("evaluator", SLEEPS, learns=False)
    with pytest.raises(RunError, match="was killed by SIGABRT"):
        check_until(workers, 1000)


def test_an_environment_that_fails_again_and_again_ends_the_training(workers: Workers) -> None:
    workers.start("waiting", SLEEPS)
    workers.start("broken", f"import sys; print('my.py, line 7', file=sys.stderr); sys.exit({BROKEN_ENVIRONMENT})")
    with pytest.raises(RunError, match=r"(?s)worker broken ended with code 4 and is not started again.*my.py, line 7"):
        check_until(workers, 1000)
    assert len(workers.told) == restarts.MOST_REFUSALS


def test_an_evaluator_that_refuses_ends_no_training(workers: Workers) -> None:
    workers.start("good", SLEEPS)
    workers.start("evaluator", REFUSES, learns=False)
    check_until(workers, restarts.MOST_REFUSALS)
    workers.check()


def test_the_last_words_of_a_worker_are_short_and_a_log_that_is_gone_has_none(tmp_path: Path) -> None:
    log = tmp_path / "w.log"
    assert tail(log) == ""
    log.write_text("x" * 50_000 + "\nlast words\n", encoding="utf-8")
    first, last = tail(log).splitlines()
    assert (len(first), first[-3:], last) == (LONGEST_LINE, "...", "last words")


def test_a_worker_that_does_not_end_in_time_is_killed_and_told_of(
    workers: Workers, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local, "END_DEADLINE_S", 0.5)
    mark = tmp_path / "deaf"
    workers.start("deaf", DEAF.format(mark=str(mark)))
    workers.start("good", SLEEPS)
    deadline = time.monotonic() + DEADLINE_S
    while not mark.exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    running = {f"worker {name}": worker.process for name, worker in workers.workers.items()}
    end_processes(running, lambda text, _: workers.told.append(text))
    (line,) = workers.told
    assert line.startswith("worker deaf did not end within")
    assert workers.workers["deaf"].process.returncode == -signal.SIGKILL


def test_a_worker_whose_log_was_deleted_is_started_again(workers: Workers, tmp_path: Path) -> None:
    workers.start("p1", CRASHES)
    worker = workers.workers["p1"]
    worker.process.wait(DEADLINE_S)
    worker.log.unlink()
    deadline = time.monotonic() + DEADLINE_S
    while worker.restarts == 0:
        workers.check()
        assert time.monotonic() < deadline
    assert worker.log.exists()
