"""Finds the endpoints of a running coordinator."""

from __future__ import annotations

import sys
from pathlib import Path

from t4nmtd_dist.runs.running import Running, named_run, running_runs
from t4nmtd_dist.wire.endpoints import CONTROL_PORT, DEFAULT_CONTROL, DEFAULT_STATE, STATE_PORT, complete_endpoint


def control_endpoint(directory: Path | None, connect: str | None, *, quiet: bool = False) -> str:
    """The control endpoint: ``connect``, else of the run in ``directory``, else of the newest active run.

    Args:
        directory: of a run.
        connect: an endpoint, or a part of one.
        quiet: do not name other active runs.

    Raises:
        ConfigError: if ``connect`` is malformed.
        RunError: if the directory holds no run.
        RunOverError: if that run can no longer be queried.
    """
    if connect is not None:
        return complete_endpoint(connect, CONTROL_PORT)
    run = _wanted(directory, quiet)
    return DEFAULT_CONTROL if run is None else run.control


def state_endpoint(directory: Path | None, connect: str | None) -> str:
    """The state endpoint; otherwise like ``control_endpoint``."""
    if connect is not None:
        return complete_endpoint(connect, STATE_PORT)
    run = _wanted(directory, quiet=False)
    return DEFAULT_STATE if run is None else run.state


def _wanted(directory: Path | None, quiet: bool) -> Running | None:
    if directory is not None:
        return named_run(directory)
    running = running_runs()
    if len(running) > 1 and not quiet:
        others = ", ".join(str(run.path) for run in running[1:])
        print(f"t4nmtd: this is {running[0].path}; also running: {others}", file=sys.stderr)
    return running[0] if running else None
