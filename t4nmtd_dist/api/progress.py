"""A progress line for scripts and notebooks."""

from __future__ import annotations

import time
from collections.abc import Callable

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from t4nmtd_dist.launch.protocol import Handle
from t4nmtd_dist.wire.messages import Status

EVERY_S = 0.5
ANSWER_S = 1.0
PAUSE_S = 0.05


def show_progress(handle: Handle, keep_going: Callable[[], bool]) -> None:
    """Show interactions, success and consecutive successes until the run is over.

    Rich draws the line on a terminal and in a notebook; elsewhere it prints only the last one.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[told]}"), TimeElapsedColumn())
    with Progress(*columns, auto_refresh=False) as progress:
        line = progress.add_task("starting", total=None, told="")
        due = 0.0
        while keep_going():
            if time.monotonic() >= due:
                status = handle.status(ANSWER_S)
                if status is not None:
                    progress.update(
                        line,
                        description=status.task,
                        total=status.max_interactions,
                        completed=status.interactions,
                        told=_told(status),
                    )
                progress.refresh()
                due = time.monotonic() + EVERY_S
            elif handle.endpoints is not None:
                time.sleep(PAUSE_S)


def _told(status: Status) -> str:
    success = "no evaluation yet" if status.success_rate is None else f"success {status.success_rate:.0%}"
    row = f"{status.solved_in_a_row} of {status.solved_needed} in a row"
    return f"{status.interactions:,} interactions, {success}, {row}"
