"""Finds active runs and their coordinators' endpoints by their folders."""

from __future__ import annotations

import fcntl
import json
from dataclasses import dataclass
from pathlib import Path

from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.runs.directory import CONFIG_FILE, ENDPOINTS_FILE, LOCK_FILE, SUMMARY_FILE, read_summary
from t4nmtd_dist.wire.addresses import here
from t4nmtd_dist.wire.endpoints import check_endpoint

RUNS = Path("runs")
LATEST = "latest"


@dataclass(frozen=True)
class Running:
    """An active run, and its endpoints as reached from this machine."""

    path: Path
    control: str
    state: str


class RunOverError(RunError):
    """The named run cannot be queried; the text says how it ended, or why."""


def running_runs(root: Path = RUNS) -> list[Running]:
    """Active runs below ``root``/<task>/, newest first."""
    found = {path.resolve(): path for path in root.glob(f"*/*/{ENDPOINTS_FILE}") if path.parent.name != LATEST}
    newest_first = sorted(found.values(), key=_written, reverse=True)
    return [_read(path.parent) for path in newest_first if is_locked(path.parent)]


def named_run(folder: Path) -> Running:
    """The run in a folder, or in its ``latest``.

    Raises:
        RunError: if there is no run.
        RunOverError: if it is over, or does not listen.
    """
    path = folder if (folder / CONFIG_FILE).exists() else folder / LATEST
    if not (path / CONFIG_FILE).exists():
        raise RunError(f"no run in {folder}: expected a run directory such as runs/task7/latest, or a folder of runs")
    path = path.parent / path.readlink() if path.is_symlink() else path
    if not is_locked(path):
        raise RunOverError(_ending(path))
    if not (path / ENDPOINTS_FILE).exists():
        raise RunOverError(f"the run in {path} listens nowhere: it is just starting, or runs in one process (--serial)")
    return _read(path)


def _ending(path: Path) -> str:
    if not (path / SUMMARY_FILE).exists():
        return f"{path} does not run, and has no {SUMMARY_FILE}: it was killed, or runs on another machine"
    summary = read_summary(path)
    what = f"{summary.get('task')} seed {summary.get('seed')}"
    spent = f"{summary.get('interactions_total')} interactions, {summary.get('wall_s')} s"
    return f"{path} is over: {what}, {summary.get('outcome')} after {spent}"


def _written(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def is_locked(path: Path) -> bool:
    """Whether a live process holds the folder's lock (``RunDirectory.lock``)."""
    try:
        with (path / LOCK_FILE).open(encoding="utf-8") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def _read(path: Path) -> Running:
    file = path / ENDPOINTS_FILE
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        control, state = str(found["control"]), str(found["state"])
        check_endpoint(control)
        check_endpoint(state)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunError(f"{file} does not say where the coordinator listens: {error}") from None
    return Running(path, here(control), here(state))
