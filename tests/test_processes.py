"""The commands as a user starts them: errors, training by hand and by launcher, and processes that die."""

from __future__ import annotations

import json
import os
import pty
import re
import shutil
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from fcntl import ioctl
from pathlib import Path

import pytest
from processes import POLL_S, Processes, Started, endpoints, events, processes_of, worker_number

from t4nmtd_dist.wire.messages import DashboardState, LearnerRow

SUBTASKS = ("p1", "p2", "p3", "g")
ERROR_S = 3.0
END_S = 5.0
SOLVE_S = 200.0


@pytest.fixture(scope="module")
def bare_start_s() -> float:
    """What starting an interpreter with torch takes on this machine now."""
    began = time.monotonic()
    subprocess.run([sys.executable, "-c", "import torch"], check=True, timeout=100)
    return time.monotonic() - began


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Run directory of a coordinator whose sub-task p1 is held by the worker ``first``."""
    started = Processes(tmp_path_factory.mktemp("held"))
    run = started.folder / "run"
    try:
        started.coordinator(run)
        started.worker(run, "--pid", "p1", "--instance", "first")
        started.until(lambda: "first takes p1 (epoch 1)" in events(run), "p1 is held")
        yield run
    finally:
        started.end()


def refused(started: Started, bare_start_s: float, *texts: str) -> None:
    """Asserts one clear message, exit code 2, no traceback, within three seconds of work."""
    code = started.wait(60)
    seconds = time.monotonic() - started.began
    print(f"{seconds:.2f} s (torch alone {bare_start_s:.2f} s): {' '.join(started.command[1:])}")
    assert code == 2, started.story()
    assert started.out == ""
    assert "Traceback" not in started.err
    messages = [line for line in started.err.splitlines() if line.startswith("t4nmtd")]
    assert len(messages) == 1, started.story()
    for text in texts:
        assert text in started.err
    assert seconds < ERROR_S + bare_start_s


NO_MONA = {"PATH": "/nonexistent"}
OTHER_PORTS = ("--bind", "tcp://127.0.0.1:*", "--publish", "tcp://127.0.0.1:*")
MISTAKES = {
    "syntax error": ("t4nmtd", ["inspect", "--formula", "F(a & "], {}, ["syntax error", "column 6"]),
    "unsatisfiable": ("t4nmtd", ["inspect", "--formula", "F(a) & G(!a)"], {}, ["unsatisfiable"]),
    "valid": ("t4nmtd", ["inspect", "--formula", "F(a) | G(!a)"], {}, ["valid"]),
    "unknown task, inspect": ("t4nmtd", ["inspect", "--task", "task77"], {}, ["task77", "task7"]),
    "unknown task, train": ("t4nmtd", ["train", "--task", "task77"], {}, ["task77", "task7"]),
    "unknown task, coordinator": ("t4nmtd-coordinator", ["--task", "task77"], {}, ["task77", "task7"]),
    "unknown key, train": ("t4nmtd", ["train", "--task", "task7", "--set", "learner.gama=1"], {}, ["learner.gamma"]),
    "unknown key, coordinator": (
        "t4nmtd-coordinator",
        ["--task", "task7", "--set", "learner.gama=1"],
        {},
        ["learner.gamma"],
    ),
    "no mona, inspect": ("t4nmtd", ["inspect", "--task", "task7", "--translator", "mona"], NO_MONA, ["mona"]),
    "no mona, train": ("t4nmtd", ["train", "--task", "task7", "--translator", "mona"], NO_MONA, ["mona"]),
    "no mona, coordinator": (
        "t4nmtd-coordinator",
        ["--task", "task7", "--translator", "mona", *OTHER_PORTS],
        NO_MONA,
        ["mona"],
    ),
    "lease of no time": ("t4nmtd-coordinator", ["--task", "task7", "--lease", "0"], {}, ["--lease"]),
    "malformed endpoint": ("t4nmtd-worker", ["--connect", "localhost"], {}, ["tcp://HOST:PORT"]),
    "too many workers": (
        "t4nmtd",
        ["train", "--task", "task7", "--workers", "5"],
        {},
        ["--workers 5", "expected 1 to 4"],
    ),
    "no workers": ("t4nmtd", ["train", "--task", "task7", "--workers", "0"], {}, ["--workers 0", "expected 1 to 4"]),
    "serial with workers": ("t4nmtd", ["train", "--task", "task7", "--serial", "--workers", "2"], {}, ["--serial"]),
    "evaluator with a pid": ("t4nmtd-worker", ["--evaluate", "--pid", "p1"], {}, ["--evaluate"]),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_gives_one_message_and_exit_code_2(mistake: str, processes: Processes, bare_start_s: float) -> None:
    script, arguments, environment, texts = MISTAKES[mistake]
    refused(processes.start(script, *arguments, env=environment), bare_start_s, *texts)


@pytest.mark.parametrize("script", ["t4nmtd", "t4nmtd-coordinator"])
def test_a_run_directory_in_use_is_refused(script: str, processes: Processes, bare_start_s: float) -> None:
    run = processes.folder / "run"
    run.mkdir()
    (run / "config.toml").write_text("kept")
    command = ["train"] if script == "t4nmtd" else [*OTHER_PORTS]
    started = processes.start(script, *command, "--task", "task7", "--run-dir", str(run))
    refused(started, bare_start_s, "--restart")
    assert (run / "config.toml").read_text() == "kept"


def test_a_port_in_use_is_refused_and_no_run_directory_left(
    held: Path, processes: Processes, bare_start_s: float
) -> None:
    run = processes.folder / "run"
    for taken in (["--bind", endpoints(held)[0]], ["--publish", endpoints(held)[1]]):
        started = processes.start("t4nmtd-coordinator", "--task", "task7", "--run-dir", str(run), *OTHER_PORTS, *taken)
        refused(started, bare_start_s, "in use", taken[1])
        assert not run.exists()


def test_an_unknown_pid_is_refused(held: Path, processes: Processes, bare_start_s: float) -> None:
    refused(processes.worker(held, "--pid", "p9"), bare_start_s, "unknown pid 'p9'", "g, p1, p2, p3")


def test_a_pid_whose_lease_is_live_is_refused(held: Path, processes: Processes, bare_start_s: float) -> None:
    refused(processes.worker(held, "--pid", "p1"), bare_start_s, "p1 is held by first")


def test_a_worker_without_coordinator_says_for_what_it_waits_and_gives_up(processes: Processes) -> None:
    worker = processes.start("t4nmtd-worker", "--pid", "p1", "--connect", "tcp://127.0.0.1:9", "--wait", "2")
    assert worker.wait(30) == 2
    seconds = time.monotonic() - worker.began
    first, last = worker.err.splitlines()
    assert "waiting for the coordinator at tcp://127.0.0.1:9" in first
    assert "no coordinator answered" in last
    assert seconds > 2


def rows(state: DashboardState) -> dict[str, LearnerRow]:
    return {row.pid: row for row in state.learners}


def all_held(state: DashboardState) -> bool:
    return all(row.worker for row in state.learners)


def finished_run(run: Path) -> dict[str, object]:
    """The summary, after a check of what lies beside it."""
    for name in ("config.toml", "versions.json", "events.jsonl", "summary.json", "policy/policy.json"):
        assert (run / name).is_file(), name
    assert {path.stem for path in (run / "metrics").glob("*.csv")} == {*SUBTASKS, "evaluations"}
    assert (run / "policy" / "actors.safetensors").is_file()
    assert (run / "logs").is_dir()
    assert (run.parent / "latest").resolve() == run.resolve()
    summary: dict[str, object] = json.loads((run / "summary.json").read_text())
    return summary


def evaluated(processes: Processes, path: Path) -> dict[str, float]:
    started = processes.start("t4nmtd", "evaluate", str(path), "--episodes", "20", "--json")
    assert started.wait(60) == 0, started.story()
    found: dict[str, float] = json.loads(started.out)
    return found


@pytest.mark.training
@pytest.mark.timeout(300)
def test_processes_started_by_hand_solve_task7(processes: Processes) -> None:
    run = processes.folder / "run"
    coordinator = processes.coordinator(run, "--seed", "7")
    roles = [["--pid", pid] for pid in SUBTASKS] + [["--evaluate"]]
    workers = [processes.worker(run, *role) for role in roles]
    processes.until(lambda: coordinator.process.poll() is not None, "task7 is solved", SOLVE_S)
    assert coordinator.wait(1) == 0, coordinator.story()
    assert [worker.wait(5) for worker in workers] == [0] * len(workers), [worker.story() for worker in workers]
    summary = finished_run(run)
    assert (summary["task"], summary["seed"], summary["solved"], summary["success_rate"]) == ("task7", 7, True, 1.0)
    wanted = {"interactions", "episode_length", "wall_s", "gradient_steps", "intervention"}
    assert wanted <= summary.keys()
    intervention = summary["intervention"]
    assert isinstance(intervention, dict)
    assert {"asked", "answered", "late", "own_used", "lag_mean"} <= intervention.keys()
    assert intervention["answered"] > 0
    found = evaluated(processes, run)
    assert found["success_rate"] == 1.0
    assert found["episodes"] == 20
    assert {"mean_length", "mean_return"} <= found.keys()
    elsewhere = shutil.copytree(run / "policy", processes.folder / "copied")
    assert evaluated(processes, elsewhere)["success_rate"] == 1.0


@pytest.mark.training
@pytest.mark.timeout(300)
def test_a_worker_killed_before_its_first_success_starts_again_and_the_task_is_solved(processes: Processes) -> None:
    run = processes.folder / "run"
    command = ["train", "--task", "task7", "--seed", "8", "--run-dir", str(run), "--no-dashboard"]
    launcher = processes.start("t4nmtd", *command)
    processes.until(lambda: "g takes g (epoch 1)" in events(run), "g is held")
    number = worker_number(run, "g")
    assert number is not None
    assert rows(processes.until_state(run, lambda state: True, "a state"))["g"].total.recent_success is None
    os.kill(number, signal.SIGKILL)
    processes.until(lambda: "g takes g (epoch 2)" in events(run), "g is held again")
    assert worker_number(run, "g") not in (None, number)
    assert launcher.wait(SOLVE_S) == 0, launcher.story()
    assert finished_run(run)["solved"] is True
    assert processes_of(run) == {}
    outcome = launcher.out.splitlines()
    assert len(outcome) == 1, launcher.story()
    assert "solved" in outcome[0]
    assert launcher.err == ""


def test_a_spent_budget_gives_exit_code_3_and_plain_lines_without_a_terminal(processes: Processes) -> None:
    run = processes.folder / "run"
    launcher = processes.start("t4nmtd", "train", "--task", "task7", "--run-dir", str(run), "--max-interactions", "1")
    assert launcher.wait(90) == 3, launcher.story()
    assert "budget spent" in launcher.out.splitlines()[-1]
    assert re.match(r"0:00:\d\d task7 starting \| ", launcher.out), launcher.out
    assert "\x1b" not in launcher.out
    assert "\r" not in launcher.out
    assert launcher.err == ""
    assert json.loads((run / "summary.json").read_text())["outcome"] == "budget spent"
    assert processes_of(run) == {}


class Terminal:
    """A pseudo-terminal whose output is kept."""

    def __init__(self) -> None:
        self._ours, self.theirs = pty.openpty()
        ioctl(self.theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 30, 100, 0, 0))
        self.settings = termios.tcgetattr(self.theirs)
        self.shown = b""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        try:
            while piece := os.read(self._ours, 4096):
                self.shown += piece
        except OSError:
            return

    def restored(self) -> bool:
        """Whether the normal screen, the cursor and the line settings are back."""
        screen = self.shown.rfind(b"\x1b[?1049l") > self.shown.rfind(b"\x1b[?1049h") >= 0
        cursor = self.shown.rfind(b"\x1b[?25h") > self.shown.rfind(b"\x1b[?25l") >= 0
        return screen and cursor and termios.tcgetattr(self.theirs) == self.settings

    def close(self) -> None:
        os.close(self.theirs)
        os.close(self._ours)


def all_gone(run: Path, since: float) -> None:
    while left := processes_of(run):
        logs = "\n".join(f"{path.name}: {path.read_text()}" for path in (run / "logs").iterdir())
        assert time.monotonic() - since < END_S, f"still there: {left}\n{logs}"
        time.sleep(POLL_S)
    print(f"all gone after {time.monotonic() - since:.2f} s")


def spawned(processes: Processes, run: Path) -> None:
    processes.until(lambda: worker_number(run, "evaluator") is not None, "the workers are started")


def training(processes: Processes, run: Path) -> None:
    processes.until_state(run, lambda state: state.phase == "training", "training has begun")


def interrupt_group(launcher: Started) -> None:
    os.killpg(launcher.process.pid, signal.SIGINT)


def terminate(launcher: Started) -> None:
    launcher.send(signal.SIGTERM)


@pytest.mark.parametrize(
    ("moment", "stop"), [(training, interrupt_group), (spawned, terminate)], ids=["Ctrl-C", "SIGTERM"]
)
def test_a_stopped_launcher_ends_everything_and_gives_the_terminal_back(
    moment: Callable[[Processes, Path], None], stop: Callable[[Started], None], processes: Processes
) -> None:
    run, terminal = processes.folder / "run", Terminal()
    command = ["train", "--task", "task7", "--run-dir", str(run)]
    launcher = processes.start("t4nmtd", *command, env={"TERM": "xterm-256color"}, terminal=terminal.theirs)
    processes.until(lambda: (run / "endpoints.json").exists(), "the coordinator listens")
    processes.until(lambda: b"\x1b[?1049h" in terminal.shown, "the dashboard is shown")
    moment(processes, run)
    since = time.monotonic()
    stop(launcher)
    assert launcher.wait(3 * END_S) == 130
    all_gone(run, since)
    assert json.loads((run / "summary.json").read_text())["outcome"] == "stopped"
    processes.until(terminal.restored, "the terminal is given back", END_S)
    assert b"Traceback" not in terminal.shown
    terminal.close()


@pytest.mark.parametrize("moment", [spawned, training], ids=["while workers start", "in training"])
def test_nothing_outlives_a_killed_launcher(moment: Callable[[Processes, Path], None], processes: Processes) -> None:
    run = processes.folder / "run"
    launcher = processes.start("t4nmtd", "train", "--task", "task7", "--run-dir", str(run))
    processes.until(lambda: (run / "endpoints.json").exists(), "the coordinator listens")
    moment(processes, run)
    since = time.monotonic()
    launcher.send(signal.SIGKILL)
    launcher.wait(END_S)
    all_gone(run, since)


def test_a_killed_coordinator_ends_the_launcher_with_a_message(processes: Processes) -> None:
    run = processes.folder / "run"
    launcher = processes.start("t4nmtd", "train", "--task", "task7", "--run-dir", str(run), "--no-dashboard")
    processes.until(lambda: (run / "endpoints.json").exists(), "the coordinator listens")
    spawned(processes, run)
    coordinator = next(number for number, command in processes_of(run).items() if "coordinator" in command)
    os.kill(coordinator, signal.SIGKILL)
    since = time.monotonic()
    assert launcher.wait(END_S) == 2
    assert "the coordinator ended with code -9" in launcher.err
    assert "Traceback" not in launcher.err
    all_gone(run, since)


def test_a_worker_that_slept_through_its_lease_goes_on_or_gives_way(processes: Processes) -> None:
    run = processes.folder / "run"
    coordinator = processes.coordinator(run, "--lease", "1.5")
    sleeper = processes.worker(run, "--pid", "p1", "--instance", "sleeper")
    training(processes, run)
    sleeper.send(signal.SIGSTOP)
    lost = processes.until_state(run, lambda state: rows(state)["p1"].phase == "lost", "p1 is lost")
    sleeper.send(signal.SIGCONT)
    processes.until_state(run, lambda state: state.interactions > lost.interactions, "p1 goes on")
    assert "p1 heard again" in events(run)
    sleeper.send(signal.SIGSTOP)
    lost = processes.until_state(run, lambda state: rows(state)["p1"].phase == "lost", "p1 is lost again")
    successor = processes.worker(run, "--pid", "p1", "--instance", "heir")
    processes.until_state(run, lambda state: state.interactions > lost.interactions, "the heir learns p1")
    sleeper.send(signal.SIGCONT)
    assert sleeper.wait(END_S) == 2
    assert "epoch 1 of p1 is over: heir holds epoch 2" in sleeper.err
    heard = processes.until_state(run, lambda state: True, "a state").interactions
    processes.until_state(run, lambda state: state.interactions > heard, "the heir goes on")
    coordinator.send(signal.SIGINT)
    assert [coordinator.wait(END_S), successor.wait(END_S)] == [130, 0]


def test_a_closed_terminal_ends_worker_and_coordinator_in_good_order(processes: Processes) -> None:
    run = processes.folder / "run"
    coordinator, worker = processes.coordinator(run), processes.worker(run, "--pid", "p1")
    training(processes, run)
    worker.send(signal.SIGHUP)
    assert worker.wait(END_S) == 130
    processes.until(lambda: "p1 given back" in events(run), "the sub-task is free again")
    coordinator.send(signal.SIGHUP)
    assert coordinator.wait(END_S) == 130
    assert "stopped: SIGHUP" in events(run)


def test_a_roll_out_longer_than_the_lease_loses_nothing(processes: Processes) -> None:
    run = processes.folder / "run"
    processes.coordinator(run, "--lease", "2", "--set", "ppo.rollout=15000", "--set", "ppo.epochs=1")
    processes.worker(run, "--pid", "p1")
    told = processes.until_state(run, lambda state: state.interactions > 0, "the first roll-out is told of")
    assert told.interactions == 16 * 15000
    assert not [text for text in events(run) if text.startswith("p1 lost")]


def test_workers_go_on_with_a_coordinator_started_again_on_the_same_ports(processes: Processes) -> None:
    first, second = processes.folder / "first", processes.folder / "second"
    killed = processes.coordinator(first)
    workers = [processes.worker(first, "--pid", pid) for pid in ("p1", "p2")]
    before = processes.until_state(
        first, lambda state: all(rows(state)[pid].version > 1 for pid in ("p1", "p2")), "two sub-tasks learn"
    )
    killed.send(signal.SIGKILL)
    control, publish = endpoints(first)
    again = processes.coordinator(second, bind=control, publish=publish)
    for pid in ("p1", "p2"):
        earlier = rows(before)[pid].version
        after = processes.until_state(
            second, lambda state, p=pid, v=earlier: rows(state)[p].version > v, f"{pid} learns on"
        )
        assert rows(after)[pid].epoch == 1
    again.send(signal.SIGTERM)
    assert [again.wait(END_S), *(worker.wait(END_S) for worker in workers)] == [130, 0, 0]


def test_a_worker_that_outlives_its_coordinator_begins_anew_for_another_seed(processes: Processes) -> None:
    first, second = processes.folder / "first", processes.folder / "second"
    killed, worker = processes.coordinator(first), processes.worker(first, "--pid", "p1", "--pid", "p2")
    processes.until_state(first, lambda state: rows(state)["p1"].version > 3, "p1 learns")
    killed.send(signal.SIGKILL)
    control, publish = endpoints(first)
    again = processes.coordinator(second, "--seed", "1", bind=control, publish=publish)
    for pid in ("p1", "p2"):
        processes.until_state(
            second, lambda state, p=pid: rows(state)[p].version > 0, f"{pid} learns from the beginning"
        )
    again.send(signal.SIGTERM)
    assert [again.wait(END_S), worker.wait(END_S)] == [130, 0]
    assert "p1 is over here: the coordinator trains another task now, or with another seed" in worker.err


def test_two_workers_without_pid_share_all_subtasks(processes: Processes) -> None:
    run = processes.folder / "run"
    coordinator = processes.coordinator(run)
    workers = [processes.worker(run, "--instance", name) for name in ("one", "two")]
    shared = processes.until_state(run, all_held, "every sub-task is held")
    assert {row.worker for row in shared.learners} == {"one", "two"}
    coordinator.send(signal.SIGINT)
    assert [coordinator.wait(END_S), *(worker.wait(END_S) for worker in workers)] == [130, 0, 0]
