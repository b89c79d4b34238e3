"""A solved run whose result cannot be written at once: it waits, makes room, and can be resumed to write it."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from coordinator_events import Conversation, weights
from processes import Processes
from small_tasks import small_task
from test_full_disk import files_end_after
from test_resume import report

from coordinator.checkpointing import StateCheckpointing
from coordinator.events import Finish
from coordinator.finishing import write_result
from coordinator.run_logger import RunLogger
from coordinator.run_settings import RunSettings
from coordinator.saved_state import saved_state
from t4nmtd_dist.cli.train import train
from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.launch.serial import SerialRun
from t4nmtd_dist.runs.checkpoints import write_checkpoint
from t4nmtd_dist.runs.directory import RunDirectory
from t4nmtd_dist.runs.options import RunOptions
from t4nmtd_dist.runs.reserve import Reserve
from t4nmtd_dist.runs.resuming import Identity, read_stopped_run, write_identity
from t4nmtd_dist.wire.messages import EvaluationJob, EvaluationPoll, LearnerStats

DISK = 8_000_000
HIDDEN = "learner.hidden=[400, 400]"
WEIGHTS = weights(1.0, HIDDEN)
ABOUT = {"run_id": "", "place": "coordinator"}


def begun() -> Conversation:
    talk = Conversation(HIDDEN)
    talk.claim("p1")
    talk.claim_evaluator("e")
    return talk


def solve(talk: Conversation) -> Finish:
    """Perfect evaluations until the run is solved."""
    for number in range(1, 20):
        stats = LearnerStats(phase="training", interactions=10_000 * number, processor_s=100.0 * number)
        talk.sync("p1", "w", sequence=number, stats=stats, version=number, arrays=WEIGHTS)
        job = talk.answer("e", EvaluationPoll(epoch=1))
        assert isinstance(job, EvaluationJob)
        for action in talk.send("e", report(1, job.job, 1.0)):
            if isinstance(action, Finish):
                return action
    raise AssertionError("not solved")


class Run:
    """The coordinator's writers of a run in ``folder``."""

    def __init__(self, folder: Path) -> None:
        self.talk, self.told = begun(), list[str]()
        self.directory = RunDirectory(folder / "run")
        write_identity(self.directory.path, Identity("", serial=False))
        self.keeper = StateCheckpointing(self.talk.state, self.directory.checkpoints, 300.0, self.told.append)
        self.recorder = RunLogger(self.talk.state, self.directory, "off", self.told.append)

    @property
    def policy(self) -> Path:
        return self.directory.path / "policy" / "policy.json"

    def checkpoint(self) -> None:
        write_checkpoint(self.directory.checkpoints / "coordinator", ABOUT, saved_state(self.talk.state))

    def end(self, *, tries: int = 3, room: int | None = None) -> int:
        """Write the result; after ``room`` pauses something makes room; how many pauses that took."""
        pauses: list[int] = []

        def pause() -> bool:
            pauses.append(1)
            if len(pauses) == room:
                (self.directory.path.parent / "ballast").unlink()
            return len(pauses) < tries

        write_result(self.recorder, self.keeper, self.told.append, pause)
        return len(pauses)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A small disk of its own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = os.geteuid() == 0 and shutil.which("mount") is not None
    if not mounted or subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK}", "none", folder]).returncode:
        pytest.skip("only root can mount a small disk")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def fill(folder: Path) -> None:
    """Leave no room at all."""
    with (folder / "ballast").open("wb", buffering=0) as file:
        for size in (4096, 1):
            try:
                while True:
                    file.write(bytes(size))
            except OSError:
                continue


def test_the_result_waits_for_room_and_is_written_then(disk: Path) -> None:
    run = Run(disk)
    fill(disk)
    run.recorder.record(solve(run.talk))
    assert run.end(room=2) == 2
    assert run.policy.exists()
    assert run.directory.read_summary()["solved"]
    assert any("trying again" in text for text in run.told)
    assert not (run.directory.checkpoints / "coordinator").exists()


def test_a_solved_run_makes_room_by_deleting_its_older_checkpoints(disk: Path) -> None:
    run = Run(disk)
    solved = solve(run.talk)
    for _ in range(3):
        run.checkpoint()
    fill(disk)
    run.recorder.record(solved)
    assert run.end() == 0
    assert run.policy.exists()
    assert run.directory.read_summary()["solved"]


def test_room_for_the_result_is_reserved_while_there_is_some(disk: Path) -> None:
    run = Run(disk)
    solved = solve(run.talk)
    run.keeper.turn()
    fill(disk)
    run.recorder.record(solved)
    assert run.end() == 0
    assert run.policy.exists()
    assert run.directory.read_summary()["solved"]
    assert not (run.directory.path / ".reserve").exists()


def test_what_could_not_be_reserved_is_reserved_once_there_is_room(tmp_path: Path) -> None:
    reserve = Reserve(tmp_path)
    with files_end_after(1):
        reserve.hold(1000)
    assert not list(tmp_path.iterdir())
    reserve.hold(1000)
    assert [path.stat().st_size for path in tmp_path.iterdir()] == [1000]


def test_a_result_that_finds_no_room_leaves_the_newest_checkpoint(disk: Path) -> None:
    run = Run(disk)
    solved = solve(run.talk)
    for _ in range(2):
        run.checkpoint()
    with files_end_after(1):
        run.recorder.record(solved)
        with pytest.raises(RunError, match=r"cannot write the result .* --resume"):
            run.end()
    assert [path.name for path in sorted((run.directory.checkpoints / "coordinator").iterdir())] == ["000002"]
    assert read_stopped_run(run.directory.path).outcome == ""


def test_an_unsolved_run_does_not_wait_and_keeps_its_last_checkpoint(tmp_path: Path) -> None:
    run = Run(tmp_path)
    run.talk.sync("p1", "w", stats=LearnerStats(interactions=5))
    shutil.rmtree(run.directory.path / "metrics")
    (run.directory.path / "metrics").write_text("in the way", encoding="utf-8")
    (run.directory.path / "summary.json").mkdir()
    with pytest.raises(RunError, match="cannot write the result"):
        run.end()
    assert (run.directory.checkpoints / "coordinator" / "000001").exists()


def test_a_serial_run_that_was_solved_is_resumed_to_write_its_result(tmp_path: Path) -> None:
    task = small_task()
    serial = SerialRun(task, RunSettings(0, 10**6, lease_s=float("inf")), lambda: 0.0)
    serial.round()
    serial.coordinator.outcome = "solved"
    run = RunDirectory(tmp_path / "run")
    run.write_settings(task.config, 0, 10**6)
    write_identity(run.path, Identity("", serial=True))
    write_checkpoint(run.checkpoints / "serial", {"run_id": "", "place": "serial"}, serial.state_dict())
    assert train(RunOptions(resume=run.path, translator="python"), launcher="serial") == 0
    assert run.read_summary()["interactions_total"] == serial.coordinator.interactions
    assert run.read_summary()["outcome"] == "solved"
    assert not (run.checkpoints / "serial").exists()


def test_a_resume_of_a_solved_run_writes_its_result_without_training(tmp_path: Path, commands: Processes) -> None:
    run = Run(tmp_path)
    solve(run.talk)
    run.checkpoint()
    interactions = run.talk.state.interactions
    resumed = commands.start("t4nmtd", "train", "--resume", str(run.directory.path), "--no-dashboard")
    assert resumed.wait(90) == 0, resumed.story()
    summary = run.directory.read_summary()
    assert summary["solved"]
    assert summary["interactions_total"] == interactions
    assert run.policy.exists()
    assert "solved" in resumed.out
    again = commands.start("t4nmtd", "train", "--resume", str(run.directory.path), "--no-dashboard")
    assert again.wait(60) == 0
    assert "solved task7 already" in again.out
