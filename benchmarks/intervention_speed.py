"""Throughput of task 5's four learners with policy intervention against none, in real processes.

    python benchmarks/intervention_speed.py [--json] [--rounds 6] [--slice 10]

Every mode has its own coordinator and workers. Modes run in alternating time slices while the others are stopped by
SIGSTOP, so that load slows all alike. The figures come from the coordinators: environment steps, updates, rows asked,
late, own critic used, version lag. Ratios to ``off`` are by wall clock and by the workers' CPU time, which is less
sensitive to load but excludes waiting.

Only learners with successes query peers, which takes minutes of training. The coordinators therefore begin with
scripted start states near the targets and a Q-table that knows each sub-task. The rest is normal training of untrained
networks. The measurement begins when every learner has successes and updates. Trained runs may ask for more or fewer
rows per batch, so success rates and rows are printed.

``--resume RUN`` instead resumes a copy of a stopped run of task 5 per mode, with only ``learner.intervention`` changed
and evaluations disabled. ``--set`` changes settings of modes that do not resume, such as ``learner.hidden=[256,256]``.

It needs psutil (the ``test`` extra).
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil
import tomli_w

from coordinator.endpoints import Access
from coordinator.run_settings import RunSettings
from coordinator.service import CoordinatorService, RunStorage
from coordinator.state import CoordinatorState
from envs.racecar_track import TARGET_RADIUS, TARGETS, on_track
from t4nmtd_dist.environments.preparation import prepared
from t4nmtd_dist.launch.command_lines import python_command
from t4nmtd_dist.launch.program import assign_pids
from t4nmtd_dist.method.compiled import compile_task
from t4nmtd_dist.runs.directory import CHECKPOINTS_FOLDER, CONFIG_FILE, ENDPOINTS_FILE
from t4nmtd_dist.tasks import load_task
from t4nmtd_dist.wire.messages import Status
from t4nmtd_dist.wire.status_client import StatusClient
from t4nmtd_dist.wire.zmq_types import new_context

PIDS = ("g1", "g2", "g3", "g4")
STARTS = 50
WARM_UPDATES = 100
START_S = 600.0
BUDGET = 10**12
NO_EVALUATIONS = f"evaluation.every={BUDGET}"  # otherwise workers evaluate between turns
LOOPBACK = "tcp://127.0.0.1:*"
SELDOM = ("--checkpoint-every", "1e9")
ANSWER_S = 60.0


@dataclass(frozen=True)
class Mode:
    """An intervention mode, and the number of processes its learners share."""

    name: str
    intervention: str
    workers: int = len(PIDS)


MODES = (
    Mode("off", "off"),
    Mode("query", "query"),
    Mode("replica", "replica"),
    Mode("local, 1 worker", "local", 1),
    Mode("query, 2 workers", "query", 2),
)


@dataclass
class Counts:
    """The work of one mode's learners within its slices."""

    seconds: float = 0.0
    cpu_s: float = 0.0
    steps: int = 0
    updates: int = 0
    asked: int = 0
    answered: int = 0
    late: int = 0
    own_used: int = 0
    lag_total: int = 0

    def add(self, before: Status, after: Status, seconds: float, cpu_s: float) -> None:
        """Add a slice."""
        self.seconds += seconds
        self.cpu_s += cpu_s
        for sign, status in ((-1, before), (1, after)):
            for row in status.learners:
                self.steps += sign * row.total.interactions
                self.updates += sign * row.total.gradient_steps
                for name in ("asked", "answered", "late", "own_used", "lag_total"):
                    setattr(self, name, getattr(self, name) + sign * getattr(row.total.intervention, name))


@dataclass
class Run:
    """The processes of one mode."""

    mode: Mode
    folder: Path
    flags: Sequence[str]
    resume: Path | None
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)
    slices: list[Counts] = field(default_factory=list)

    def start(self) -> None:
        """Start a coordinator and the workers."""
        self.folder.mkdir(parents=True)
        self._spawn(self._fresh() if self.resume is None else self._resumed(self.resume), "coordinator")
        endpoints = self.folder / "run" / ENDPOINTS_FILE
        deadline = time.monotonic() + START_S
        while not endpoints.exists():
            self._check(deadline)
        control = json.loads(endpoints.read_text(encoding="utf-8"))["control"]
        for name, held in assign_pids(PIDS, self.mode.workers).items():
            places = [part for pid in held for part in ("--pid", pid)]
            if self.resume is not None:
                places += ["--checkpoints", str(self.folder / "run" / CHECKPOINTS_FOLDER), *SELDOM]
            self._spawn([*python_command("worker"), "--connect", control, "--instance", name, *places], name)
        self.status_client = StatusClient(new_context(), control)
        self.status_client.handshake(ANSWER_S)

    def _fresh(self) -> list[str]:
        settings = [f"learner.intervention={self.mode.intervention}", NO_EVALUATIONS, *self.flags]
        flags = [part for flag in settings for part in ("--set", flag)]
        return [sys.executable, __file__, "--serve", str(self.folder), *flags]

    def _resumed(self, stopped: Path) -> list[str]:
        """A coordinator that resumes a copy of the stopped run with this intervention mode."""
        run = self.folder / "run"
        shutil.copytree(stopped.resolve(), run)
        (run / ENDPOINTS_FILE).unlink(missing_ok=True)
        settings = tomllib.loads((run / CONFIG_FILE).read_text(encoding="utf-8"))
        settings["learner"]["intervention"] = self.mode.intervention
        settings["evaluation"]["every"] = BUDGET
        (run / CONFIG_FILE).write_text(tomli_w.dumps(settings), encoding="utf-8")
        command = [*python_command("coordinator"), "--resume", str(run), "--no-dashboard", *SELDOM]
        command += ["--bind", LOOPBACK, "--publish", LOOPBACK, "--lease", "1e9"]
        return [*command, "--max-interactions", str(BUDGET)]

    def _spawn(self, command: list[str], name: str) -> None:
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
        with (self.folder / f"{name}.log").open("wb") as log:
            self.processes.append(subprocess.Popen(command, stdout=log, stderr=log, env=environment))

    def _check(self, deadline: float) -> None:
        if time.monotonic() > deadline or any(process.poll() is not None for process in self.processes):
            logs = "\n".join(f"{log}: {log.read_text()[-500:]}" for log in self.folder.glob("*.log"))
            raise SystemExit(f"{self.mode.name}: it ended or did not get ready within {START_S:.0f} s\n{logs}")
        time.sleep(0.1)

    def warm_up(self) -> None:
        """Run until every learner has successes and updates."""
        deadline = time.monotonic() + START_S
        while True:
            learners = self.status().learners
            if all(row.total.gradient_steps > WARM_UPDATES and row.total.recent_success for row in learners):
                return
            self._check(deadline)

    def status(self) -> Status:
        """The coordinator's status."""
        return self.status_client.status(ANSWER_S)

    def signal(self, number: signal.Signals) -> None:
        """Stop or continue all processes."""
        for process in self.processes:
            process.send_signal(number)

    def _cpu_s(self) -> float:
        times = [psutil.Process(process.pid).cpu_times() for process in self.processes[1:]]
        return sum(each.user + each.system for each in times)

    def take_turn(self, seconds: float) -> None:
        """Run and measure a slice."""
        self.signal(signal.SIGCONT)
        before, cpu_s, began = self.status(), self._cpu_s(), time.monotonic()
        time.sleep(seconds)
        after, cpu_s, elapsed = self.status(), self._cpu_s() - cpu_s, time.monotonic() - began
        self.signal(signal.SIGSTOP)
        counts = Counts()
        counts.add(before, after, elapsed, cpu_s)
        self.slices.append(counts)

    def end(self) -> None:
        """Kill the processes."""
        for process in self.processes:
            process.kill()
            process.wait()


def scripted_starts(pid: str) -> list[np.ndarray[tuple[int, ...], np.dtype[np.float64]]]:
    """Cars at rest outside the target of ``pid``, within two radii of it."""
    rng, (x, y) = np.random.default_rng(PIDS.index(pid)), TARGETS[PIDS.index(pid)]
    angles, distances = rng.uniform(0, 2 * np.pi, STARTS), rng.uniform(1.1, 2.0, STARTS) * TARGET_RADIUS
    places = zip(x + distances * np.cos(angles), y + distances * np.sin(angles), strict=True)
    return [np.array([px, py, *[0.0] * 8]) for px, py in places if on_track(px, py)]


def serve(folder: Path, flags: Sequence[str]) -> None:
    """Run one mode's coordinator with scripted start states and Q-table."""
    task = prepared(compile_task(load_task("task5", flags=flags)))
    run = folder / "run"
    settings = RunSettings(seed=0, max_interactions=BUDGET, run_dir=str(run), lease_s=1e9)
    state = CoordinatorState(task, settings)
    entries = []
    for q in range(task.dfa.states):
        for pid in task.decomposition.available(q):
            entries.append((q, pid, 1.0))
            for start in scripted_starts(pid):
                state.records[pid].buffer.add(q, start)
    state.method.load(entries)
    CoordinatorService(state, RunStorage(run), Access(LOOPBACK, LOOPBACK, None, False)).serve()


def results(runs: Sequence[Run]) -> list[dict[str, object]]:
    """One row per mode, with ratios to the first, ``off``."""
    rows = []
    for run in runs:
        total = Counts(**{name: sum(getattr(each, name) for each in run.slices) for name in vars(Counts())})
        rates = [total.steps / total.seconds, total.updates / total.seconds, total.updates / total.cpu_s]
        by_slice = [each.updates / each.seconds for each in run.slices]
        spread = statistics.stdev(by_slice) / statistics.mean(by_slice) if len(by_slice) > 1 else 0.0
        rows.append(
            {
                "mode": run.mode.name,
                "processes": run.mode.workers,
                "steps_s": round(rates[0], 1),
                "updates_s": round(rates[1], 1),
                "updates_cpu_s": round(rates[2], 1),
                "spread": round(spread, 3),
                "rows_per_batch": round(total.asked / total.updates, 2),
                "own_used": round(total.own_used / total.asked, 4) if total.asked else None,
                "late": round(total.late / total.asked, 4) if total.asked else None,
                "lag_mean": round(total.lag_total / total.answered, 3) if total.answered else None,
                "success": [round(row.total.recent_success or 0.0, 2) for row in run.status().learners],
            }
        )
    for row in rows:
        for name in ("steps_s", "updates_s", "updates_cpu_s"):
            row[f"ratio_{name}"] = round(row[name] / rows[0][name], 3)  # type: ignore[operator]
    return rows


def table(rows: Sequence[dict[str, object]]) -> str:
    """The rows as text."""
    columns = {
        "mode": "mode", "processes": "workers", "steps_s": "steps/s", "updates_s": "updates/s", "spread": "spread",
        "ratio_steps_s": "ratio steps", "ratio_updates_s": "ratio updates", "ratio_updates_cpu_s": "ratio per cpu s",
        "updates_cpu_s": "per cpu s", "rows_per_batch": "rows/batch", "own_used": "own critic", "late": "late",
        "lag_mean": "lag", "success": "success",
    }  # fmt: skip
    cells = [list(columns.values())] + [["-" if row[k] is None else str(row[k]) for k in columns] for row in rows]
    widths = [max(len(line[i]) for line in cells) for i in range(len(columns))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in cells)


def measure(
    modes: Sequence[Mode], rounds: int, seconds: float, flags: Sequence[str], resume: Path | None
) -> list[dict[str, object]]:
    with tempfile.TemporaryDirectory() as folder:
        runs = [Run(mode, Path(folder) / str(number), flags, resume) for number, mode in enumerate(modes)]
        try:
            for run in runs:
                run.start()
                run.warm_up()
                run.signal(signal.SIGSTOP)
            for number in range(rounds):
                for run in runs[number % len(runs) :] + runs[: number % len(runs)]:
                    run.take_turn(seconds)
            for run in runs:
                run.signal(signal.SIGCONT)
            return results(runs)
        finally:
            for run in runs:
                run.end()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.add_argument("--modes", nargs="+", choices=[mode.name for mode in MODES], help="all by default, off first")
    parser.add_argument("--rounds", type=int, default=6, help="slices of each mode")
    parser.add_argument("--slice", type=float, default=10.0, help="seconds of a slice")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of all modes")
    parser.add_argument("--resume", type=Path, metavar="RUN", help="begin from this stopped run of task 5")
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that `finally` ends the modes' processes
    if arguments.serve is not None:
        serve(arguments.serve, arguments.set)
        return
    modes = [mode for mode in MODES if arguments.modes is None or mode.name in {"off", *arguments.modes}]
    rows = measure(modes, arguments.rounds, arguments.slice, arguments.set, arguments.resume)
    print(json.dumps({"modes": rows}) if arguments.json else table(rows))


if __name__ == "__main__":
    main()
