"""A disk that is full, or a folder that is gone: trainings go on, and say what is missing."""

from __future__ import annotations

import resource
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from coordinator_events import Conversation

from coordinator.events import Finish, LogEvent
from coordinator.run_logger import RunLogger
from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.runs.directory import RunDirectory


@pytest.fixture
def talk() -> Conversation:
    talk = Conversation()
    talk.claim("p1")
    talk.send("w", talk.sync_message("p1", "w"))
    return talk


@contextmanager
def files_end_after(size: int) -> Iterator[None]:
    """Writing beyond the first bytes of any file fails, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_line_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    run, row = RunDirectory(tmp_path / "run"), {"a": 1, "b": "x" * 20}
    run.append_metrics("p1", row)
    size = (run.path / "metrics" / "p1.csv").stat().st_size
    with files_end_after(size + 10), pytest.raises(OSError, match="large"):
        run.append_metrics("p1", row)
    run.append_metrics("p1", row)
    lines = (run.path / "metrics" / "p1.csv").read_text(encoding="utf-8").splitlines()
    assert lines == ["a,b", *["1," + "x" * 20] * 2]


def test_what_cannot_be_written_is_told_once_and_ends_nothing(talk: Conversation, tmp_path: Path) -> None:
    told: list[str] = []
    recorder = RunLogger(talk.state, RunDirectory(tmp_path / "run"), "off", told.append)
    with files_end_after(1):
        for _ in range(3):
            recorder.record(LogEvent(0.0, "a line"))
            recorder.metrics()
    assert len(told) == 1
    assert told[0].startswith(f"cannot write to {tmp_path / 'run'}: ")
    recorder.record(LogEvent(0.0, "room again"))
    assert "room again" in (tmp_path / "run" / "events.jsonl").read_text(encoding="utf-8")


def test_a_result_that_could_not_be_written_is_written_when_there_is_room(talk: Conversation, tmp_path: Path) -> None:
    told: list[str] = []
    run = RunDirectory(tmp_path / "run")
    recorder = RunLogger(talk.state, run, "off", told.append)
    with files_end_after(1):
        recorder.record(Finish("stopped", "a reason"))
        assert not (run.path / "summary.json").exists()
        with pytest.raises(RunError, match=r"cannot write the result .*--resume"):
            recorder.close()
    recorder.close()
    assert run.read_summary()["task"] == "task7"


def test_a_run_directory_that_was_deleted_ends_nothing_before_the_end(talk: Conversation, tmp_path: Path) -> None:
    told: list[str] = []
    recorder = RunLogger(talk.state, RunDirectory(tmp_path / "run"), "off", told.append)
    shutil.rmtree(tmp_path / "run")
    recorder.record(LogEvent(0.0, "a line"))
    assert "No such file" in told[0]
    with pytest.raises(RunError, match="No such file"):
        recorder.close()
