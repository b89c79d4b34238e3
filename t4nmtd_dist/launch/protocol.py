"""What a launcher is. To add one, write a module with a function ``start`` and add a line to ``LAUNCHERS``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from t4nmtd_dist.launch.program import Program
from t4nmtd_dist.wire.messages import Status

SOLVED, BUDGET_SPENT, STOPPED = 0, 3, 130
OUTCOMES = (SOLVED, BUDGET_SPENT, STOPPED)
"""Exit codes of a run that came to an end with a result."""


@dataclass(frozen=True)
class Endpoints:
    """Where a running coordinator listens.

    Attributes:
        control: for workers and status requests.
        state: for dashboards.
    """

    control: str
    state: str


@dataclass(frozen=True)
class Supervisor:
    """What a launcher may ask of, and tell, whoever started the program.

    Attributes:
        report: called with a text about a process that failed, and whether the user should see it on the terminal.
        interrupted: whether the user wants the run to stop.
    """

    report: Callable[[str, bool], None] = lambda text, urgent: None
    interrupted: Callable[[], bool] = lambda: False


class Handle(Protocol):
    """A program that was started.

    The loop it is meant for::

        while handle.check() and not interrupted():
            pause()
        if interrupted():
            handle.interrupt()
        code = handle.exit_code(timeout_s)
        handle.end()
    """

    @property
    def endpoints(self) -> Endpoints | None:
        """Where its coordinator listens; None if all roles share this process."""

    def check(self) -> bool:
        """Look after the processes (or do a part of the work); False once the run is over.

        Called several times a second, and must return soon.

        Raises:
            RunError: if the run cannot go on.
        """

    def status(self, timeout_s: float) -> Status | None:
        """How the run is; None if the coordinator has not answered in time."""

    def interrupt(self) -> None:
        """Ask the run to stop: it writes its result and checkpoints, and ends."""

    def exit_code(self, timeout_s: float) -> int | None:
        """The run's exit code (see ``OUTCOMES``), waited for if need be; None if it has not ended in time.

        Raises:
            RunError: if the result cannot be written.
        """

    def end(self) -> None:
        """End whatever is left of the program, and release what it holds; also called after an error."""

    def failure(self) -> str:
        """Why the run ended without an outcome; asked after ``end``."""


class Launcher(Protocol):
    """A way to start a program; a module with such a function is one."""

    def start(self, program: Program, supervisor: Supervisor) -> Handle:
        """Start all roles of a program; its run directory is ready.

        Raises:
            RunError: if they cannot be started; nothing is left running then.
        """
