"""Runs that go on now, as their folders tell: by the lock, newest first, without getting in a coordinator's way."""

from __future__ import annotations

import fcntl
import json
import os
import threading
import time
from pathlib import Path

import pytest

from t4nmtd_dist.cli.whereabouts import control_endpoint, state_endpoint
from t4nmtd_dist.core.errors import ConfigError, RunError
from t4nmtd_dist.runs.directory import CONFIG_FILE, ENDPOINTS_FILE, LOCK_FILE, RunDirectory
from t4nmtd_dist.runs.running import RunOverError, named_run, running_runs
from t4nmtd_dist.wire.endpoints import DEFAULT_CONTROL, DEFAULT_STATE


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run_in(path: str, port: int, *, live: bool = True, written: int = 0) -> RunDirectory:
    """A run as a coordinator on two ports leaves it in a folder; locked if it lives."""
    run = RunDirectory(Path(path))
    (run.path / CONFIG_FILE).write_text('formula = "a"\nseed = 0\n')
    if live:
        run.lock()
    run.write_endpoints(f"tcp://0.0.0.0:{port}", f"tcp://127.0.0.1:{port + 1}")
    os.utime(run.path / ENDPOINTS_FILE, (written, written))
    return run


def test_the_newest_live_run_is_asked_and_the_others_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    kept = [run_in("runs/task4/a", 7000, written=1), run_in("runs/task7/b", 7010, written=3)]
    run_in("runs/task7/c", 7020, live=False, written=9)
    assert control_endpoint(None, None) == "tcp://127.0.0.1:7010"
    assert capsys.readouterr().err == "t4nmtd: this is runs/task7/b; also running: runs/task4/a\n"
    assert state_endpoint(None, None) == "tcp://127.0.0.1:7011"
    assert control_endpoint(None, None, quiet=True) == "tcp://127.0.0.1:7010"
    kept[1].unlock()
    capsys.readouterr()
    assert control_endpoint(None, None) == "tcp://127.0.0.1:7000"
    assert capsys.readouterr().err == ""


def test_without_a_live_run_it_is_the_usual_endpoint() -> None:
    assert (control_endpoint(None, None), state_endpoint(None, None)) == (DEFAULT_CONTROL, DEFAULT_STATE)
    run_in("runs/task7/b", 7010, live=False)
    assert (control_endpoint(None, None), state_endpoint(None, None)) == (DEFAULT_CONTROL, DEFAULT_STATE)


def test_connect_wins_over_everything() -> None:
    run = run_in("runs/task7/b", 7010)
    assert control_endpoint(run.path, "hare") == "tcp://hare:5570"
    assert state_endpoint(Path("nowhere"), "tcp://hare:1") == "tcp://hare:1"
    with pytest.raises(ConfigError, match="tcp://HOST:PORT"):
        control_endpoint(None, "")


@pytest.mark.parametrize("name", ["elsewhere/mine", "elsewhere/latest", "elsewhere", "elsewhere/mine/"])
def test_a_run_is_named_by_its_directory_its_link_or_the_folder_above(name: str) -> None:
    run = run_in("elsewhere/mine", 7030)
    assert control_endpoint(Path(name), None) == "tcp://127.0.0.1:7030"
    assert named_run(Path(name)).path == run.path


def test_a_run_that_is_over_says_how_it_ended() -> None:
    run = run_in("runs/task7/b", 7010, live=False)
    with pytest.raises(RunOverError, match=r"runs/task7/b does not run, and has no summary\.json"):
        named_run(Path("runs/task7"))
    summary = {"task": "task7", "seed": 3, "outcome": "solved", "interactions_total": 1234, "wall_s": 5.5}
    run.write_summary(summary)
    with pytest.raises(
        RunOverError, match=r"^runs/task7/b is over: task7 seed 3, solved after 1234 interactions, 5\.5 s$"
    ):
        named_run(Path("runs/task7/latest"))


def test_what_is_no_run_or_does_not_listen_is_refused() -> None:
    for name in ("nowhere", "runs"):
        with pytest.raises(RunError, match=f"no run in {name}"):
            named_run(Path(name))
    run = run_in("runs/task7/b", 7010)
    (run.path / ENDPOINTS_FILE).write_text(json.dumps({"control": 3}))
    with pytest.raises(RunError, match="does not say where"):
        named_run(run.path)
    (run.path / ENDPOINTS_FILE).unlink()
    with pytest.raises(RunOverError, match="listens nowhere"):
        named_run(run.path)


def test_looking_for_runs_keeps_no_coordinator_from_starting() -> None:
    run = run_in("runs/task7/b", 7010, live=False)
    looker = (run.path / LOCK_FILE).open("a")
    fcntl.flock(looker, fcntl.LOCK_SH)
    threading.Timer(0.03, looker.close).start()
    run.lock()
    assert [found.path for found in running_runs()] == [run.path]
    run.unlock()
    assert running_runs() == []


def test_a_held_lock_is_still_refused_soon() -> None:
    run = run_in("runs/task7/b", 7010, live=False)
    began = time.monotonic()
    with (run.path / LOCK_FILE).open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(RunError, match="still going on"):
            run.lock()
    assert time.monotonic() - began < 2.0
