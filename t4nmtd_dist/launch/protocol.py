"""The launcher interface. To add one, write a module with a function ``start`` and add a line to ``LAUNCHERS``."""

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
    """Endpoints of a running coordinator.

    Attributes:
        control: for workers and status requests.
        state: for dashboards.
    """

    control: str
    state: str


@dataclass(frozen=True)
class Supervisor:
    """Callbacks from a launcher to its caller.

    Attributes:
        report: called with a text about a failed process, and whether it is urgent.
        interrupted: whether the user wants the run to stop.
    """

    report: Callable[[str, bool], None] = lambda text, urgent: None
    interrupted: Callable[[], bool] = lambda: False


class Handle(Protocol):
    """A started program.

    The intended loop::

        while handle.check() and not interrupted():
            pause()
        if interrupted():
            handle.interrupt()
        code = handle.exit_code(timeout_s)
        handle.end()
    """

    @property
    def endpoints(self) -> Endpoints | None:
        """The coordinator's endpoints; None if all roles share this process."""

    def check(self) -> bool:
        """Supervise the processes, or do some of the work; False once the run is over.

        Called several times a second, so it must return quickly.

        Raises:
            RunError: if the run cannot continue.
        """

    def status(self, timeout_s: float) -> Status | None:
        """The run's status; None if the coordinator does not answer in time."""

    def interrupt(self) -> None:
        """Ask the run to write its result and checkpoints, and stop."""

    def exit_code(self, timeout_s: float) -> int | None:
        """Wait for the run's exit code (see ``OUTCOMES``); None after the timeout.

        Raises:
            RunError: if the result cannot be written.
        """

    def end(self) -> None:
        """End what is left and release resources; also called after errors."""

    def failure(self) -> str:
        """Why the run ended without an outcome; called after ``end``."""


class Launcher(Protocol):
    """A module with this function is a launcher."""

    def start(self, program: Program, supervisor: Supervisor) -> Handle:
        """Start all roles of a program, whose run directory is ready.

        Raises:
            RunError: if they cannot be started; nothing is left running.
        """
