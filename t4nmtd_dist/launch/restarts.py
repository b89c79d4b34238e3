"""Restarts worker processes that die, up to a limit."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from t4nmtd_dist.core.errors import BROKEN_ENVIRONMENT, RunError
from t4nmtd_dist.launch.logs import size, tail

EARLY_S = 60.0  # a learner that exits earlier has hardly learned anything
RESTART_PAUSE_S = 0.5
MOST_RESTARTS = 20
MOST_REFUSALS = 3
REFUSALS = (2, BROKEN_ENVIRONMENT)  # exit codes for user-fixable problems
FORGIVEN_S = 600.0  # a worker that ran this long gets its refusals reset
KILLED_BY = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)  # deliberate, not a crash


class Process(Protocol):
    """A process on this machine; ``subprocess.Popen`` is one."""

    pid: int

    @property
    def returncode(self) -> int | None:
        """The exit code as of the last ``poll`` or ``wait``."""

    def poll(self) -> int | None:
        """The exit code, negative for a signal; None while running."""

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the exit code.

        Raises:
            subprocess.TimeoutExpired: if it does not end within ``timeout`` seconds.
        """

    def terminate(self) -> None:
        """Send SIGTERM."""

    def kill(self) -> None:
        """Send SIGKILL."""


@dataclass
class Worker:
    """A worker process and its history.

    Attributes:
        learns: whether it is a learner rather than an evaluator.
        refusals: number of exits with a code for user-fixable problems.
        given_up: whether it is no longer restarted.
        restart_at: time of the next restart; None while running.
        log_size: bytes of its log at the last start.
        began: start time of its process, on a monotonic clock in seconds.
        lived_s: runtime in seconds of the last ended process.
    """

    name: str
    start: Callable[[], Process]
    log: Path
    learns: bool
    process: Process = field(init=False)
    restarts: int = field(default=0, init=False)
    refusals: int = field(default=0, init=False)
    given_up: bool = field(default=False, init=False)
    restart_at: float | None = field(default=None, init=False)
    log_size: int = field(default=0, init=False)
    began: float = field(default_factory=time.monotonic, init=False)
    lived_s: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        self.process = self.start()

    @property
    def code(self) -> int:
        """Exit code of the last ended process."""
        return self.process.returncode or 0

    @property
    def refused_at_start(self) -> bool:
        """Whether its first process refused before it can have learned much."""
        first = self.restarts == 0 and self.restart_at is not None and self.code in REFUSALS
        return first and self.lived_s < EARLY_S

    @property
    def is_urgent(self) -> bool:
        """Whether the user should see its end: it failed by itself, or was killed again."""
        return self.restarts > 0 or -self.code not in KILLED_BY

    def death_report(self) -> str:
        """How it ended, what happens next, and its last log lines."""
        how = f"was killed by {signal.Signals(-self.code).name}" if self.code < 0 else f"ended with code {self.code}"
        fate = "is not started again; others go on" if self.given_up else "is started again"
        last = f"its last lines, from {self.log}:\n{tail(self.log, self.log_size)}"
        return f"worker {self.name} {how} and {fate}; {last}".rstrip()

    def note_death(self, now: float) -> None:
        """Record its end, and schedule a restart or give up."""
        self.lived_s = now - self.began
        if self.lived_s > FORGIVEN_S:
            self.refusals = 0
        self.refusals += self.code in REFUSALS
        self.given_up = self.refusals >= MOST_REFUSALS or self.restarts >= MOST_RESTARTS
        self.restart_at = now + RESTART_PAUSE_S * 2 ** min(self.restarts, 5)

    def restart(self, now: float) -> None:
        """Restart it under the same name, to get its sub-tasks back at once."""
        self.restarts += 1
        self.restart_at = None
        self.log_size = size(self.log)
        self.process, self.began = self.start(), now


class RestartedWorkers:
    """All workers of a run on this machine.

    Args:
        report: called with the report of a dead worker, and whether it is urgent.
    """

    def __init__(self, report: Callable[[str, bool], None]) -> None:
        self._report = report
        self.workers: dict[str, Worker] = {}

    def add(self, name: str, start: Callable[[], Process], log: Path, *, learns: bool = True) -> None:
        """Start a worker.

        Args:
            name: of its role.
            start: starts its process; also used for restarts.
            log: its log file.
            learns: whether it is a learner.
        """
        self.workers[name] = Worker(name, start, log, learns)

    def check(self) -> None:
        """Restart dead workers.

        Raises:
            RunError: with the end of a log if no learner is left.
        """
        now = time.monotonic()
        for worker in self.workers.values():
            if worker.process.poll() not in (None, 0) and not worker.given_up:
                self._revive(worker, now)
        self._check_learners()

    def _revive(self, worker: Worker, now: float) -> None:
        if worker.restart_at is None:
            worker.note_death(now)
            self._report(worker.death_report(), worker.is_urgent)
        elif now >= worker.restart_at:
            worker.restart(now)

    def _check_learners(self) -> None:
        """End the run if all learners were given up or refused at the start, or one because of the environment.

        All learners share the environment, and the others might wait for that sub-task for ever.
        """
        learners = [worker for worker in self.workers.values() if worker.learns]
        if not learners:
            return
        if all(worker.refused_at_start for worker in learners) or all(worker.given_up for worker in learners):
            raise RunError(learners[0].death_report())
        for worker in learners:
            if worker.given_up and worker.code == BROKEN_ENVIRONMENT:
                raise RunError(worker.death_report())
