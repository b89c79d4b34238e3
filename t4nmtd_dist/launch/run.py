"""Runs a program to its end with a launcher."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import cast

from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.core.registry import LAUNCHERS
from t4nmtd_dist.launch.failure_reports import FailureReports
from t4nmtd_dist.launch.program import Program
from t4nmtd_dist.launch.protocol import OUTCOMES, STOPPED, Handle, Launcher, Supervisor
from t4nmtd_dist.process.signals import noted_signals
from t4nmtd_dist.runs.directory import RunDirectory
from t4nmtd_dist.wire.auth.keys import ClientKeys, load_client

CHECK_S = 0.1
OUTCOME_S = 15.0  # usual time for a coordinator to end after its last state
RESULT_S = 90.0  # time for a coordinator to give up on a full disk


Show = Callable[[Handle, Callable[[], bool]], None]
"""Shows a run for as long as a function, called several times a second, says that it goes on."""


def launch(
    program: Program,
    launcher: str = "local",
    *,
    interrupted: Callable[[], bool] | None = None,
    show: Show | None = None,
) -> int:
    """Run a program to its end.

    Args:
        program: the program.
        launcher: a key of ``core.registry.LAUNCHERS``.
        interrupted: whether the user wants the run to stop; by default after Ctrl-C, SIGTERM or SIGHUP.
        show: replaces the dashboard.

    Returns:
        The exit code: 0 solved, 3 budget spent, 130 interrupted.

    Raises:
        ConfigError: if there is no such launcher.
        RunError: if the run directory cannot be used, or a process cannot continue.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # before a launcher imports torch
    chosen = cast(Launcher, LAUNCHERS.module(launcher))
    plan = program.plan
    RunDirectory(plan.directory, restart=program.options.restart, resume=plan.resumes)
    with ExitStack() as stack:
        asked = stack.enter_context(noted_signals()) if interrupted is None else interrupted
        return _see_through(program, chosen, asked, show)


def _see_through(program: Program, launcher: Launcher, interrupted: Callable[[], bool], show: Show | None) -> int:
    keys = None if program.keys is None else load_client(program.keys)
    reports = FailureReports(keys, held=program.dashboard and _takes_the_terminal())
    handle = launcher.start(program, Supervisor(reports, interrupted))
    try:
        reports.control = "" if handle.endpoints is None else handle.endpoints.control
        if show is None:
            _watch(handle, interrupted, program.dashboard, keys)
        else:
            show(handle, lambda: handle.check() and not interrupted())
        if interrupted():
            handle.interrupt()
        code = _exit_code(program, handle, interrupted)
    finally:
        reports.release()
        handle.end()
    if code not in OUTCOMES and interrupted():
        return STOPPED
    if code is None or code not in OUTCOMES:
        raise RunError(handle.failure())
    return code


def _watch(handle: Handle, interrupted: Callable[[], bool], dashboard: bool, keys: ClientKeys | None) -> None:
    """Supervise and show the program until its end or interruption."""

    def keep_going() -> bool:
        return handle.check() and not interrupted()

    if dashboard and handle.endpoints is not None:
        from coordinator.ui.viewer import watch
        from t4nmtd_dist.wire.zmq_types import new_context

        context = new_context()
        watch(context, handle.endpoints.state, keep_going=keep_going, keys=keys)
        context.term()
        return
    pause_s = 0.0 if handle.endpoints is None else CHECK_S
    while keep_going():
        time.sleep(pause_s)


def _exit_code(program: Program, handle: Handle, interrupted: Callable[[], bool]) -> int | None:
    """The run's exit code; None after a timeout."""
    code = handle.exit_code(OUTCOME_S)
    if code is None and not interrupted():
        log = program.log(program.coordinator)
        text = f"the coordinator is still writing the result; its log is in {log.parent}"
        print(f"t4nmtd: {text}", file=sys.stderr, flush=True)
    deadline = time.monotonic() + RESULT_S
    while code is None and not interrupted() and time.monotonic() < deadline:
        code = handle.exit_code(1.0)
    return code


def _takes_the_terminal() -> bool:
    """Whether a dashboard uses the whole terminal."""
    from rich.console import Console

    from coordinator.ui.viewer import wants_plain

    return not wants_plain(Console())
