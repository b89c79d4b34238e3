"""First contact by hand: a coordinator and one worker per sub-task are all that a training needs."""

from __future__ import annotations

import json
import re
import shlex
import signal
from pathlib import Path

import pytest
from processes import LOOPBACK, Processes, Started, endpoints, events

from t4nmtd_dist.runs.directory import ENDPOINTS_FILE

END_S = 20.0
SOLVE_S = 250.0


def coordinator_of(processes: Processes, task: str, run: Path, *arguments: str) -> Started:
    ports = ["--bind", LOOPBACK, "--publish", LOOPBACK]
    started = processes.start("t4nmtd-coordinator", "--task", task, "--run-dir", str(run), *ports, *arguments)
    processes.until(lambda: (run / ENDPOINTS_FILE).exists(), "the coordinator listens")
    return started


def commands_in(text: str) -> list[list[str]]:
    """The worker commands in what a coordinator says first, as a shell would split them."""
    found = (shlex.split(line, comments=True) for line in text.splitlines() if line.startswith("  t4nmtd-worker"))
    return list({tuple(command): command for command in found}.values())


def test_a_number_names_the_subtask_where_none_is_called_so(processes: Processes) -> None:
    run = processes.folder / "run"
    coordinator = coordinator_of(processes, "task5", run)
    workers = {n: processes.worker(run, "--pid", f"p{n}", "--instance", f"w{n}") for n in (1, 4)}
    processes.until(
        lambda: {"w1 takes g1 (epoch 1)", "w4 takes g4 (epoch 1)"} <= set(events(run)), "g1 and g4 are held"
    )
    for number, worker in workers.items():
        named = f"p{number} is g{number}"
        processes.until(lambda worker=worker, named=named: named in worker.err, f"a worker says: {named}")
    stranger = processes.worker(run, "--pid", "p5")
    assert stranger.wait(END_S) == 2
    assert "g1 (p1), g2 (p2), g3 (p3), g4 (p4)" in stranger.err
    late = processes.worker(run, "--pid", "p1")
    assert late.wait(END_S) == 2
    assert "p1 is g1" in late.err
    assert "held by w1" in late.err
    coordinator.send(signal.SIGINT)
    assert [coordinator.wait(END_S), *(worker.wait(END_S) for worker in workers.values())] == [130, 0, 0]


def test_the_coordinator_says_at_once_which_commands_it_waits_for(processes: Processes) -> None:
    run = processes.folder / "run"
    coordinator = coordinator_of(processes, "task5", run)
    processes.until(lambda: len(commands_in(coordinator.out)) >= 4, "the commands are printed", 5)
    connect = ["--connect", endpoints(run)[0]]
    assert commands_in(coordinator.out)[:4] == [["t4nmtd-worker", "--pid", f"p{n}", *connect] for n in (1, 2, 3, 4)]
    processes.until(lambda: "missing g1" in coordinator.out, "the plain lines name what is missing", 10)


@pytest.mark.training
@pytest.mark.timeout(400)
def test_coordinator_and_learners_alone_solve_task7(processes: Processes) -> None:
    run = processes.folder / "run"
    coordinator = coordinator_of(processes, "task7", run, "--seed", "7")
    processes.until(lambda: len(commands_in(coordinator.out)) >= 4, "the commands are printed", 5)
    workers = [processes.start(*command) for command in commands_in(coordinator.out)]
    assert len(workers) == 4
    processes.until(lambda: coordinator.process.poll() is not None, "task7 is solved", SOLVE_S)
    assert coordinator.wait(1) == 0, coordinator.story()
    assert [worker.wait(END_S) for worker in workers] == [0] * 4, [worker.story() for worker in workers]
    summary = json.loads((run / "summary.json").read_text())
    assert (summary["solved"], summary["success_rate"]) == (True, 1.0)
    assert summary["evaluations"] >= 5
    told = [text for text in events(run) if "evaluat" in text]
    assert len([text for text in told if "between their turns" in text]) == 1, told


def test_status_and_dashboard_find_a_running_training(processes: Processes) -> None:
    launcher = processes.start("t4nmtd", "train", "--task", "task7", "--no-dashboard")
    runs = processes.folder / "runs" / "task7"
    processes.until(lambda: list(runs.glob("*-s0/endpoints.json")), "the coordinator listens")
    asked = processes.start("t4nmtd", "status")
    assert asked.wait(END_S) == 0, asked.story()
    assert re.match(r"task7 seed 0: (starting|training) ", asked.out)
    assert "t4nmtd-worker" not in asked.out, "a launcher starts its workers itself"
    named = processes.start("t4nmtd", "status", "runs/task7/latest", "--json")
    assert named.wait(END_S) == 0, named.story()
    assert json.loads(named.out)["missing"] == []
    picture = processes.start("t4nmtd", "dashboard", "--svg", "page.svg")
    assert picture.wait(END_S) == 0, picture.story()
    assert "task7" in (processes.folder / "page.svg").read_text(encoding="utf-8")
    launcher.send(signal.SIGINT)
    assert launcher.wait(END_S) == 130, launcher.story()
    over = processes.start("t4nmtd", "status", "runs/task7")
    assert over.wait(END_S) == 1
    assert "stopped after" in over.out
