"""A whole training as processes on this machine: coordinator, one worker per sub-task, evaluator."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path

from t4nmtd_dist.core.errors import BROKEN_ENVIRONMENT, ConfigError, RunError
from t4nmtd_dist.runs.directory import ENDPOINTS_FILE
from t4nmtd_dist.runs.file_names import file_name
from t4nmtd_dist.runs.links import open_to_append

START_DEADLINE_S = 60.0
END_DEADLINE_S = 20.0  # time in which workers write their last checkpoints; most need a second
RESTART_PAUSE_S = 0.5
MOST_RESTARTS = 20
MOST_REFUSALS = 3
REFUSALS = (2, BROKEN_ENVIRONMENT)
FORGIVEN_S = 600.0  # a worker that ran so long counts its refusals anew
LONGEST_NAME = 100
LONGEST_LINE = 1000  # of a log, when it is quoted
RESERVED = ("coordinator", "evaluator")  # names of processes that are no learners
KILLED_BY = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)  # somebody's wish, not a crash


def dealt(pids: Sequence[str], workers: int | None) -> dict[str, list[str]]:
    """Which sub-tasks each worker process learns, by the name of the process: dealt in turn.

    Args:
        pids: the sub-tasks.
        workers: how many processes; None for one each.

    Raises:
        ConfigError: if there would be none, or some without a sub-task.
    """
    processes = len(pids) if workers is None else workers
    if not 1 <= processes <= len(pids):
        raise ConfigError(f"--workers {processes}: expected 1 to {len(pids)}, the number of this task's sub-tasks")
    hands = [list(pids[first::processes]) for first in range(processes)]
    named: dict[str, list[str]] = {}
    for hand in hands:
        named[_name_of(hand, named)] = hand
    return named


def _name_of(hand: Sequence[str], taken: Mapping[str, object]) -> str:
    """The sub-tasks' names; a number where these are too long for the name of a log, taken or reserved."""
    joined = "+".join(map(file_name, hand))
    if len(joined) <= LONGEST_NAME and joined not in taken and joined not in RESERVED:
        return joined
    return next(name for number in count(len(taken) + 1) if (name := f"worker-{number}") not in taken)


@dataclass
class _Child:
    """A process of ours, how often it was started again, and how long its log was before that.

    Attributes:
        refusals: how often it has ended with a code for what a user can mend.
        given_up: whether it is not started again any more.
        log_size: bytes of its log when the process was started.
        began: when its process was started, in seconds of a clock that only grows.
        lived_s: how long the process that ended last had run.
    """

    name: str
    command: list[str]
    log: Path
    process: subprocess.Popen[bytes]
    restarts: int = 0
    refusals: int = 0
    given_up: bool = False
    restart_at: float | None = None
    log_size: int = 0
    began: float = field(default_factory=time.monotonic)
    lived_s: float = 0.0

    @property
    def refused_at_start(self) -> bool:
        """Whether its first process has just refused, before it can have learned much."""
        first = self.restarts == 0 and self.restart_at is not None and self.process.returncode in REFUSALS
        return first and self.lived_s < START_DEADLINE_S

    @property
    def learns(self) -> bool:
        """Whether it is a learner, not the evaluator."""
        return "--evaluate" not in self.command


@dataclass
class LocalProcesses:
    """Starts, watches and ends the processes of one training.

    A worker that dies is started again under the same instance name, so that the coordinator gives it its own
    sub-task back at once, under a new epoch.

    Args:
        run_dir: the run directory; every process logs into its ``logs`` folder.
        report: called at once with what is known of a worker that has died, and whether that deserves attention.
    """

    run_dir: Path
    report: Callable[[str, bool], None] = lambda *_: None
    _children: dict[str, _Child] = field(default_factory=dict)
    _coordinator: subprocess.Popen[bytes] | None = None

    @property
    def _coordinator_log(self) -> Path:
        return self.run_dir / "logs" / "coordinator.log"

    def start_coordinator(self, arguments: Sequence[str]) -> tuple[str, str]:
        """Start the coordinator on free ports; its control and state endpoints.

        Raises:
            RunError: if it ends at once or does not listen in time; the text is its own message.
        """
        endpoints = self.run_dir / ENDPOINTS_FILE
        endpoints.unlink(missing_ok=True)
        command = [*role("coordinator"), *arguments, "--bind", "tcp://127.0.0.1:*", "--publish", "tcp://127.0.0.1:*"]
        command += ["--run-dir", str(self.run_dir), "--no-dashboard", "--lifeline", str(os.getpid())]
        process = self._coordinator = _spawn(command, self._coordinator_log)
        deadline = time.monotonic() + START_DEADLINE_S
        while not endpoints.exists():
            if process.poll() is not None:
                raise RunError(self.coordinator_failure())
            if time.monotonic() > deadline:
                raise RunError(f"the coordinator did not listen within {START_DEADLINE_S:.0f} s")
            time.sleep(0.02)
        found = json.loads(endpoints.read_text(encoding="utf-8"))
        return found["control"], found["state"]

    def start_worker(self, name: str, arguments: Sequence[str]) -> None:
        """Start a worker whose log and instance are called ``name``; it trusts our own coordinator."""
        command = [*role("worker"), *arguments, "--trust", "--instance", name, "--lifeline", str(os.getpid())]
        log = self.run_dir / "logs" / f"{name}.log"
        self._children[name] = _Child(name, command, log, _spawn(command, log))

    def processes(self) -> dict[str, int]:
        """Process numbers of the workers by name."""
        return {name: child.process.pid for name, child in self._children.items()}

    def check(self) -> bool:
        """Start dead workers again; False once the coordinator has ended.

        Raises:
            RunError: if no learner is left; the text is the end of a log.
        """
        if self._coordinator is None or self._coordinator.poll() is not None:
            return False
        for child in self._children.values():
            if child.process.poll() not in (None, 0) and not child.given_up:
                self._revive(child)
        self._check_learners()
        return True

    def _check_learners(self) -> None:
        """End when no learner is left: all were given up, or each has refused before any got to work.

        End as well when a learner was given up because of the environment, which all learners have in common: a
        sub-task without a learner may leave the others waiting for ever.
        """
        learners = [child for child in self._children.values() if child.learns]
        if not learners:
            return
        if all(child.refused_at_start for child in learners) or all(child.given_up for child in learners):
            raise RunError(_obituary(learners[0]))
        for child in learners:
            if child.given_up and child.process.returncode == BROKEN_ENVIRONMENT:
                raise RunError(_obituary(child))

    def _revive(self, child: _Child) -> None:
        now = time.monotonic()
        if child.restart_at is None:
            child.lived_s = now - child.began
            self._count_refusal(child)
            self.report(_obituary(child), _deserves_attention(child))
            child.restart_at = now + RESTART_PAUSE_S * 2 ** min(child.restarts, 5)
        if child.given_up or now < child.restart_at:
            return
        child.restarts += 1
        child.restart_at = None
        child.log_size = _size(child.log)
        child.process, child.began = _spawn(child.command, child.log), now

    def _count_refusal(self, child: _Child) -> None:
        if child.lived_s > FORGIVEN_S:
            child.refusals = 0
        child.refusals += child.process.returncode in REFUSALS
        child.given_up = child.refusals >= MOST_REFUSALS or child.restarts >= MOST_RESTARTS

    def coordinator_exit_code(self, timeout_s: float) -> int | None:
        """The coordinator's exit code; None if it does not end within ``timeout_s``."""
        if self._coordinator is None:
            return None
        try:
            return self._coordinator.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def coordinator_failure(self) -> str:
        """What to tell of a coordinator that ended without an outcome."""
        code = self._coordinator.returncode if self._coordinator is not None else None
        return _last_words(self._coordinator_log, code)

    def interrupt(self) -> None:
        """Ask the coordinator to end the run."""
        if self._coordinator is not None and self._coordinator.poll() is None:
            self._coordinator.terminate()

    def end(self) -> None:
        """End whatever still runs, politely first; returns as soon as all have written their checkpoints."""
        running = {f"worker {child.name}": child.process for child in self._children.values()}
        running |= {"the coordinator": self._coordinator} if self._coordinator is not None else {}
        for process in running.values():
            if process.poll() is None:
                process.terminate()
        deadline = time.monotonic() + END_DEADLINE_S
        for name, process in running.items():
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                late = f"{name} did not end within {END_DEADLINE_S:.0f} s and was killed"
                self.report(f"{late}; its newest checkpoint may be older than what was counted", True)


def role(program: str) -> list[str]:
    """How a ``coordinator`` or ``worker`` is started: without the current folder on Python's path."""
    return [sys.executable, "-P", "-m", "t4nmtd_dist.cli.programs", program]


def _spawn(command: list[str], log: Path) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    with open_to_append(log) as file:
        return subprocess.Popen(command, stdout=file, stderr=file, env=environment, start_new_session=True)


def _last_words(log: Path, code: int | None) -> str:
    """The coordinator's own message if it gave one, else how it ended."""
    said = _tail(log)
    if said.startswith("t4nmtd-coordinator: "):
        return said.removeprefix("t4nmtd-coordinator: ")
    return f"the coordinator ended with code {code} before the run was over; see {log}\n{said}".rstrip()


def _deserves_attention(child: _Child) -> bool:
    """Whether a worker failed by itself, or was killed from outside and not for the first time."""
    return child.restarts > 0 or -child.process.returncode not in KILLED_BY


def _obituary(child: _Child) -> str:
    """How a worker ended, and its last words."""
    code = child.process.returncode
    how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"
    fate = "is not started again; others go on" if child.given_up else "is started again"
    last = f"its last lines, from {child.log}:\n{_tail(child.log, child.log_size)}"
    return f"worker {child.name} {how} and {fate}; {last}".rstrip()


def _tail(log: Path, begin: int = 0) -> str:
    """The last lines of a log, of those after its first ``begin`` bytes."""
    try:
        written = log.read_bytes()[begin:]
    except OSError:  # somebody has deleted it
        return ""
    lines = written.decode("utf-8", errors="replace").strip().splitlines()
    return "\n".join(line if len(line) <= LONGEST_LINE else f"{line[: LONGEST_LINE - 3]}..." for line in lines[-20:])


def _size(log: Path) -> int:
    """Bytes of a log; 0 if somebody has deleted it."""
    try:
        return log.stat().st_size
    except OSError:
        return 0
