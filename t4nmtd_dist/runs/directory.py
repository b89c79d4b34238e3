"""The run directory: ``runs/<task>/<utc>-s<seed>/`` with settings, events, metrics, summary and policy."""

from __future__ import annotations

import csv
import json
import os
import platform
import shutil
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import tomli_w

from t4nmtd_dist import __version__
from t4nmtd_dist.config import TaskConfig
from t4nmtd_dist.errors import RunError

CONFIG_FILE = "config.toml"
SUMMARY_FILE = "summary.json"
ENDPOINTS_FILE = "endpoints.json"
PACKAGES = ("torch", "numpy", "gymnasium", "pyzmq", "msgpack", "msgspec", "safetensors", "ltlf2dfa")


def default_run_directory(task: str, seed: int) -> Path:
    """``runs/<task>/<utc>-s<seed>`` below the current folder."""
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    return Path("runs") / task / f"{stamp}-s{seed}"


def write_atomically(path: Path, text: str) -> None:
    """Replace a file so that a reader sees the old text or the new one, never half of it."""
    fresh = path.with_name(f".{path.name}.new")
    with fresh.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(fresh, path)


class RunDirectory:
    """One training's folder.

    Args:
        path: the folder; its parents are made.
        restart: begin anew in a folder that holds an earlier run, which is then deleted.

    Raises:
        RunError: if the folder holds a run and ``restart`` is not given, or cannot be written.
    """

    def __init__(self, path: Path, *, restart: bool = False) -> None:
        self.path = path
        try:
            self._prepare(restart)
        except OSError as error:
            raise RunError(f"cannot write the run directory {path}: {error.strerror}") from None

    def _prepare(self, restart: bool) -> None:
        if (self.path / CONFIG_FILE).exists():
            if not restart:
                raise RunError(f"{self.path} holds a run already; pass --restart to delete it, or choose another")
            shutil.rmtree(self.path)
        for name in ("metrics", "logs"):
            (self.path / name).mkdir(parents=True, exist_ok=True)
        self._point_latest()

    def _point_latest(self) -> None:
        fresh = self.path.parent / ".latest.new"
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(self.path.name, target_is_directory=True)
        os.replace(fresh, self.path.parent / "latest")

    def write_settings(self, config: TaskConfig, seed: int, max_interactions: int) -> None:
        """Resolved settings and the versions of everything that computes."""
        run = {"seed": seed, "max_interactions": max_interactions}
        settings = {key: value for key, value in config.to_dict().items() if key != "max_interactions"}
        write_atomically(self.path / CONFIG_FILE, tomli_w.dumps({**settings, **run}))
        write_atomically(self.path / "versions.json", json.dumps(_versions(), indent=1))

    def write_endpoints(self, control: str, state: str) -> None:
        """Where the coordinator listens, for those who started it."""
        write_atomically(self.path / ENDPOINTS_FILE, json.dumps({"control": control, "state": state}))

    def log_event(self, elapsed_s: float, text: str) -> None:
        """Append a line to ``events.jsonl``."""
        line = {"utc": datetime.now(UTC).isoformat(timespec="milliseconds"), "elapsed_s": round(elapsed_s, 3)}
        with (self.path / "events.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps({**line, "text": text}) + "\n")

    def append_metrics(self, name: str, row: Mapping[str, Any]) -> None:
        """Append a row to ``metrics/<name>.csv``; the first row decides the columns."""
        path = self.path / "metrics" / f"{name}.csv"
        fresh = not path.exists()
        with path.open("a", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=list(row))
            if fresh:
                writer.writeheader()
            writer.writerow(row)

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write ``summary.json``."""
        write_atomically(self.path / SUMMARY_FILE, json.dumps(summary, indent=1))

    def read_summary(self) -> dict[str, Any]:
        """Read ``summary.json``.

        Raises:
            RunError: if the run has none.
        """
        return read_summary(self.path)


def read_summary(path: Path) -> dict[str, Any]:
    """The summary of the run in ``path``.

    Raises:
        RunError: if there is none, or it is damaged.
    """
    try:
        summary: dict[str, Any] = json.loads((path / SUMMARY_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RunError(f"no readable {SUMMARY_FILE} in {path}: {error}") from None
    return summary


def _versions() -> dict[str, str]:
    return {"t4nmtd-dist": __version__, "python": platform.python_version(), **_package_versions(PACKAGES)}


def _package_versions(names: Sequence[str]) -> dict[str, str]:
    found = {}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
