"""The run directory: ``runs/<task>/<utc>-s<seed>/`` with settings, events, metrics, summary and policy."""

from __future__ import annotations

import csv
import fcntl
import io
import json
import os
import shutil
import time
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

import tomli_w

from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.runs.file_names import file_name
from t4nmtd_dist.runs.links import open_fresh, open_to_append, refuse_links
from t4nmtd_dist.runs.reserve import RESERVE_FILE
from t4nmtd_dist.runs.versions import versions

CONFIG_FILE = "config.toml"
SUMMARY_FILE = "summary.json"
ENDPOINTS_FILE = "endpoints.json"
CHECKPOINTS_FOLDER = "checkpoints"
LOCK_FILE = ".lock"
VERSIONS_FILE = "versions.json"
EVENTS_FILE = "events.jsonl"
RUN_FORMAT = 2
"""Of settings, counts and checkpoints together; a run of another format cannot be resumed. 1 was version 0.1.0."""
ROUNDING_S = 0.001  # of times in the metrics
LOCK_TRIES, LOCK_PAUSE_S = 5, 0.02
FILES = {CONFIG_FILE, SUMMARY_FILE, ENDPOINTS_FILE, LOCK_FILE, VERSIONS_FILE, EVENTS_FILE, RESERVE_FILE}
FOLDERS = {"metrics", "logs", "tensorboard", "policy", "policy.old", CHECKPOINTS_FOLDER}


def default_run_directory(task: str, seed: int) -> Path:
    """``runs/<task>/<utc>-s<seed>`` below the current folder."""
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    return Path("runs") / task / f"{stamp}-s{seed}"


def real_path(run: Path) -> Path:
    """A run directory with links such as ``latest``, and ``.``, resolved."""
    return run.resolve() if run.is_symlink() or run.name in ("", "..") else run


def write_atomically(path: Path, text: str) -> None:
    """Replace a file so that readers see either the old or the new text."""
    fresh = path.with_name(f".{path.name}.new")
    with open_fresh(fresh) as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(fresh, path)


def _append(path: Path, text: str) -> None:
    """Append to a file, all or nothing."""
    data = text.encode()
    with open_to_append(path) as file:
        size = file.tell()
        try:
            while data:
                data = data[file.write(data) :]
        except OSError:
            with suppress(OSError):
                file.truncate(size)
            raise


def _is_of_a_run(name: str) -> bool:
    """Whether a run writes an entry of this name."""
    return name.removesuffix(".new").removeprefix("." if name.endswith(".new") else "") in FILES | FOLDERS


def check_own_files(run: Path) -> None:
    """Reject a run directory with a symbolic link where a run reads or writes.

    Raises:
        RunError: with the link.
    """
    refuse_links(run, _is_of_a_run)


def _are_of_a_run(settings: Path) -> bool:
    """Whether settings look as if ``write_settings`` wrote them."""
    try:
        return {"formula", "seed"} <= tomllib.loads(settings.read_text(encoding="utf-8")).keys()
    except ValueError:
        return False


def _until(line: str, elapsed_s: float) -> bool:
    """Whether a line is not a metrics row after ``elapsed_s``."""
    first, comma, _ = line.partition(",")
    try:
        return not comma or float(first) <= elapsed_s + ROUNDING_S
    except ValueError:
        return True


class RunDirectory:
    """The folder of one run.

    Args:
        path: the folder; its parents are created.
        restart: delete an earlier run in the folder and start over.
        resume: continue the run in the folder.

    Raises:
        RunError: if the folder holds a run without ``restart`` or ``resume``, that run is active, or the folder cannot
            be written.
    """

    def __init__(self, path: Path, *, restart: bool = False, resume: bool = False) -> None:
        self.path = real_path(path)
        self._lock: IO[bytes] | None = None
        try:
            self._prepare(restart, resume)
        except OSError as error:
            raise RunError(f"cannot write the run directory {path}: {error.strerror or error}") from None

    def _prepare(self, restart: bool, resume: bool) -> None:
        if not restart:
            check_own_files(self.path)
        if (self.path / CONFIG_FILE).exists():
            if not restart and not resume:
                raise RunError(
                    f"{self.path} holds a run already; pass --resume {self.path} to go on with it, --restart to delete "
                    "it, or choose another"
                )
            self.lock()
            self.unlock()
            if restart:
                self._delete()
        for name in ("metrics", "logs"):
            (self.path / name).mkdir(parents=True, exist_ok=True)
        self._point_latest()

    def _delete(self) -> None:
        others = sorted(path.name for path in self.path.iterdir() if not _is_of_a_run(path.name))
        if others or not _are_of_a_run(self.path / CONFIG_FILE):
            what = ", ".join(others[:3]) or CONFIG_FILE
            raise RunError(
                f"--restart would delete {self.path} with {what}, which no run has written there; move that away, or "
                "choose another --run-dir"
            )
        shutil.rmtree(self.path)

    def _point_latest(self) -> None:
        """Point the link ``latest`` at the folder unless something else has that name."""
        latest, fresh = self.path.parent / "latest", self.path.parent / ".latest.new"
        if latest.exists() and not latest.is_symlink():
            return
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(self.path.name, target_is_directory=True)
        os.replace(fresh, latest)

    def lock(self) -> None:
        """Lock the folder until this process ends, however it ends.

        Raises:
            RunError: if another process holds the lock.
        """
        file = open_to_append(self.path / LOCK_FILE)
        if not _locked(file):
            file.close()
            raise RunError(f"the run in {self.path} is still going on; stop it first")
        self._lock = file

    def unlock(self) -> None:
        """Release the lock."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    @property
    def checkpoints(self) -> Path:
        """Folder of all checkpoints."""
        return self.path / CHECKPOINTS_FOLDER

    def mend(self, elapsed_s: float) -> None:
        """Before a resume, remove half-written lines and metrics after ``elapsed_s``."""
        for path in [self.path / EVENTS_FILE, *(self.path / "metrics").glob("*.csv")]:
            if path.exists():
                lines = path.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True)
                kept = [line for line in lines if line.endswith("\n") and _until(line, elapsed_s)]
                if kept != lines:
                    write_atomically(path, "".join(kept))

    def write_settings(self, config: TaskConfig, seed: int, max_interactions: int) -> None:
        """Write the resolved settings and package versions."""
        run = {"run_format": RUN_FORMAT, "seed": seed, "max_interactions": max_interactions}
        settings = {key: value for key, value in config.to_dict().items() if key != "max_interactions"}
        write_atomically(self.path / CONFIG_FILE, tomli_w.dumps({**settings, **run}))
        write_atomically(self.path / VERSIONS_FILE, json.dumps(versions(), indent=1))

    def write_endpoints(self, control: str, state: str) -> None:
        """Write the coordinator's endpoints, for the process that started it."""
        write_atomically(self.path / ENDPOINTS_FILE, json.dumps({"control": control, "state": state}))

    def log_event(self, elapsed_s: float, text: str) -> None:
        """Append a line to ``events.jsonl``."""
        line = {"utc": datetime.now(UTC).isoformat(timespec="milliseconds"), "elapsed_s": round(elapsed_s, 3)}
        _append(self.path / EVENTS_FILE, json.dumps({**line, "text": text}) + "\n")

    def append_metrics(self, name: str, row: Mapping[str, Any]) -> None:
        """Append a row to ``metrics/<name>.csv``; the first row ever defines the columns."""
        path, text = self.path / "metrics" / f"{file_name(name)}.csv", io.StringIO(newline="")
        columns = _csv_columns(path)
        writer = csv.DictWriter(text, columns or list(row), extrasaction="ignore")
        if not columns:
            writer.writeheader()
        writer.writerow(row)
        _append(path, text.getvalue())

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write ``summary.json``."""
        write_atomically(self.path / SUMMARY_FILE, json.dumps(summary, indent=1))

    def read_summary(self) -> dict[str, Any]:
        """Read ``summary.json``.

        Raises:
            RunError: if the run has none.
        """
        return read_summary(self.path)


def _csv_columns(path: Path) -> list[str]:
    """Columns of a CSV file; empty without a file."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return next(csv.reader(file), [])
    except FileNotFoundError:
        return []


def _locked(file: IO[bytes]) -> bool:
    """Lock a file; retries while `t4nmtd status` tests the lock."""
    for _ in range(LOCK_TRIES):
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(LOCK_PAUSE_S)
            continue
        return True
    return False


def read_summary(path: Path) -> dict[str, Any]:
    """The summary of the run in ``path``.

    Raises:
        RunError: if there is none, or it is damaged.
    """
    try:
        summary = json.loads((path / SUMMARY_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise RunError(f"no readable {SUMMARY_FILE} in {path}: {error}") from None
    if not isinstance(summary, dict):
        raise RunError(f"no readable {SUMMARY_FILE} in {path}: expected an object, found {type(summary).__name__}")
    return summary
