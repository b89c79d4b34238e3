"""Resuming real trainings of task 7: after kill -9 of everything, after signals, and of one worker on its own."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import time
from pathlib import Path
from typing import Any

import psutil
import pytest
from processes import Processes, Started, endpoints, events, processes_of, worker_number

SOLVE_S = 500.0
STOP_S = 60.0
PATIENCE_S = 200.0
SLOW_S = 5.0  # less than a lease, within which a learner must be heard
OFTEN = ("--checkpoint-every", "1")
SUBTASKS = ("p1", "p2", "p3", "g")


def train(processes: Processes, run: Path, *arguments: str) -> Started:
    return processes.start("t4nmtd", "train", "--task", "task7", "--run-dir", str(run), "--no-dashboard", *arguments)


def resume(processes: Processes, run: Path, *arguments: str) -> Started:
    return processes.start("t4nmtd", "train", "--resume", str(run), "--no-dashboard", *arguments)


def kill_everything(run: Path, started: Started) -> None:
    """kill -9 of the launcher, the coordinator and all workers, which leaves none of them time for anything."""
    started.send(signal.SIGSTOP)  # or it would start workers again in between
    for number in processes_of(run):
        os.kill(number, signal.SIGKILL)
    started.send(signal.SIGKILL)
    started.process.wait()


def counts(run: Path) -> dict[str, Any]:
    path = run / "checkpoints" / "counts.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def spent(run: Path) -> int:
    return sum(total["interactions"] for total in counts(run).get("totals", {}).values())


def all_count(run: Path) -> bool:
    """Whether every learner has interactions: one that is still being started has nothing to keep."""
    totals = counts(run).get("totals", {})
    return all(pid in totals and totals[pid]["interactions"] > 0 for pid in SUBTASKS)


def checkpointed(run: Path) -> bool:
    """Whether the coordinator and all learners have a checkpoint."""
    return all(any((run / "checkpoints" / place).glob("0*")) for place in ("coordinator", *SUBTASKS))


def columns(path: Path, name: str) -> list[float]:
    with path.open(encoding="utf-8") as file:
        return [float(row[name]) for row in csv.DictReader(file)]


def assert_monotone(run: Path) -> None:
    """Counters and time never go back, in any of the metrics."""
    for path in (run / "metrics").glob("*.csv"):
        counted = {"elapsed_s", "interactions"} | (set() if path.stem == "evaluations" else {"interactions_of_all"})
        for name in counted:
            numbers = columns(path, name)
            assert numbers == sorted(numbers), (path, name)


def summary_of(run: Path) -> dict[str, Any]:
    summary: dict[str, Any] = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    return summary


@pytest.mark.timeout(900)
def test_after_kill_9_of_everything_a_run_goes_on_and_is_solved(processes: Processes) -> None:
    run = processes.folder / "run"
    first = train(processes, run, "--seed", "1", *OFTEN)
    processes.until(lambda: checkpointed(run) and spent(run) > 3000, "checkpoints of all are there", PATIENCE_S)
    kill_everything(run, first)
    before, rows = counts(run), len(columns(run / "metrics" / "p1.csv", "elapsed_s"))
    second = resume(processes, run, *OFTEN)
    assert second.wait(SOLVE_S) == 0, second.story()
    summary = summary_of(run)
    assert summary["solved"]
    assert summary["interactions_total"] > sum(total["interactions"] for total in before["totals"].values())
    for pid, total in before["totals"].items():
        assert summary["learners"][pid]["interactions"] > total["interactions"]
    assert summary["wall_s"] > before["elapsed_s"]
    assert_monotone(run)
    assert len(columns(run / "metrics" / "p1.csv", "elapsed_s")) > rows
    assert any(re.match(r"resumed after \d+ interactions from checkpoint 0", text) for text in events(run))
    for pid in SUBTASKS:
        assert "goes on from" in (run / "logs" / f"{pid}.log").read_text(encoding="utf-8")
    third = resume(processes, run)
    assert third.wait(STOP_S) == 0, third.story()
    assert "solved task7 already" in third.out
    assert not (run / "checkpoints" / "coordinator").exists()


@pytest.mark.timeout(900)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_leaves_checkpoints_of_all_that_was_counted(number: signal.Signals, processes: Processes) -> None:
    run = processes.folder / "run"
    first = train(processes, run, "--seed", "1")
    processes.until(lambda: all_count(run) and spent(run) > 3000, "all learners learn", PATIENCE_S)
    first.send(number)
    assert first.wait(STOP_S) == 130, first.story()
    for pid in SUBTASKS:
        learner = json.loads((run / "checkpoints" / pid / "000001" / "state.json").read_text(encoding="utf-8"))
        told = summary_of(run)["learners"][pid]["interactions"]
        assert learner["about"]["interactions"] == told, pid
    stopped = summary_of(run)
    second = resume(processes, run, "--max-interactions", str(stopped["interactions_total"] + 2000))
    processes.until(lambda: second.process.poll() is not None, "it refuses", STOP_S)
    assert second.process.returncode == 2
    assert "can only be raised" in second.err
    third = resume(processes, run)
    processes.until(lambda: spent(run) > stopped["interactions_total"] + 2000, "the learners go on", PATIENCE_S)
    third.send(number)
    assert third.wait(STOP_S) == 130, third.story()
    assert_monotone(run)
    for pid in SUBTASKS:
        told = summary_of(run)["learners"][pid]["interactions"]
        assert newest_about(run, pid)["interactions"] == told, pid


def newest_about(run: Path, pid: str) -> dict[str, Any]:
    newest = max((run / "checkpoints" / pid).iterdir())
    about: dict[str, Any] = json.loads((newest / "state.json").read_text(encoding="utf-8"))["about"]
    return about


@pytest.mark.timeout(900)
def test_a_killed_worker_keeps_its_replay_and_counts_nothing_twice(processes: Processes) -> None:
    run = processes.folder / "run"
    started = train(processes, run, "--seed", "1", *OFTEN, "--set", "evaluation.in_a_row=1000")
    processes.until(lambda: checkpointed(run), "checkpoints of all are there", PATIENCE_S)
    number = worker_number(run, "p1")
    assert number is not None
    psutil.Process(number).kill()
    processes.until(lambda: "p1 takes p1 (epoch 2)" in events(run), "p1 is taken again", PATIENCE_S)
    log = run / "logs" / "p1.log"
    processes.until(
        lambda: "p1 goes on from" in log.read_text(encoding="utf-8"), "p1 goes on from its checkpoint", PATIENCE_S
    )
    before = spent(run)
    processes.until(lambda: spent(run) > before + 5000, "all go on", PATIENCE_S)
    started.send(signal.SIGINT)
    assert started.wait(STOP_S) == 130, started.story()
    assert_monotone(run)
    learners = summary_of(run)["learners"]
    for pid in SUBTASKS:
        counted, kept = learners[pid]["interactions"], newest_about(run, pid)["interactions"]
        story = f"{pid}: {counted} interactions counted, {kept} in its newest checkpoint"
        assert counted >= kept if pid == "p1" else counted == kept, story


@pytest.mark.timeout(900)
def test_the_last_word_of_a_slow_learner_is_waited_for(processes: Processes) -> None:
    run = processes.folder / "run"
    started = train(processes, run, "--seed", "1")
    processes.until(lambda: all_count(run), "all learners learn", PATIENCE_S)
    number = worker_number(run, "p2")
    assert number is not None
    os.kill(number, signal.SIGSTOP)  # as if its turn took long
    started.send(signal.SIGINT)
    processes.until(lambda: "g given back" in events(run), "the others hear of the end", STOP_S)
    time.sleep(SLOW_S)
    os.kill(number, signal.SIGCONT)
    assert started.wait(STOP_S) == 130, started.story()
    counted, kept = summary_of(run)["learners"]["p2"]["interactions"], newest_about(run, "p2")["interactions"]
    assert counted == kept
    assert "p2 given back" in events(run)


def test_a_run_that_goes_on_cannot_be_resumed_or_deleted(processes: Processes) -> None:
    run = processes.folder / "run"
    processes.coordinator(run)
    for flags in (["--resume", str(run)], ["--task", "task7", "--run-dir", str(run), "--restart"]):
        refused = processes.start("t4nmtd", "train", *flags)
        assert refused.wait(STOP_S) == 2
        assert "still going on" in refused.err
    assert endpoints(run)


@pytest.mark.timeout(900)
def test_a_serial_run_killed_and_resumed_ends_as_the_uninterrupted_one(processes: Processes) -> None:
    budget = ("--serial", "--seed", "5", "--max-interactions", "12000", "--set", "evaluation.every=2000")
    whole, run = processes.folder / "whole", processes.folder / "run"
    first = train(processes, run, *budget, "--checkpoint-every", "0.1")
    processes.until(lambda: any((run / "checkpoints" / "serial").glob("*2")), "some checkpoints", PATIENCE_S)
    first.send(signal.SIGKILL)
    first.process.wait()
    second = resume(processes, run, "--serial")
    assert second.wait(SOLVE_S) == 3, second.story()
    uninterrupted = train(processes, whole, *budget)
    assert uninterrupted.wait(SOLVE_S) == 3, uninterrupted.story()
    told = [summary_of(whole), summary_of(run)]
    for summary in told:
        summary.pop("wall_s")
    assert told[0] == told[1]
    actors = [folder / "policy" / "actors.safetensors" for folder in (whole, run)]
    assert actors[0].read_bytes() == actors[1].read_bytes()
    assert columns(whole / "metrics" / "evaluations.csv", "interactions") == columns(
        run / "metrics" / "evaluations.csv", "interactions"
    )
    more = resume(processes, run, "--serial", "--max-interactions", "14000")
    assert more.wait(SOLVE_S) == 3, more.story()
    assert summary_of(run)["interactions_total"] >= 14000
