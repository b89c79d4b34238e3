"""What a stopped run needs to be gone on with: its identity, its settings, and where its checkpoints are."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from t4nmtd_dist.config import TaskConfig, read_toml, task_config
from t4nmtd_dist.errors import ConfigError, RunError
from t4nmtd_dist.runs.directory import (
    CHECKPOINTS_FOLDER,
    CONFIG_FILE,
    SUMMARY_FILE,
    check_own_files,
    read_summary,
    write_atomically,
)
from t4nmtd_dist.runs.links import open_fresh
from t4nmtd_dist.runs.state_tree import State

IDENTITY_FILE = "run.json"
COUNTS_FILE = "counts.json"
CHECKPOINT_EVERY_S = 300.0
COORDINATOR, SERIAL = "coordinator", "serial"


@dataclass(frozen=True)
class Identity:
    """What stays the same however often a run is resumed.

    Attributes:
        run_id: random; checkpoints of other runs are not gone on from.
        serial: whether it runs in one process, in lock-step.
    """

    run_id: str
    serial: bool


@dataclass(frozen=True)
class StoppedRun:
    """A run directory to go on with.

    Attributes:
        config: its settings; the budget is its own.
        outcome: how it ended before; "" if it was killed.
        interactions: spent until then, as far as its summary says.
    """

    path: Path
    config: TaskConfig
    seed: int
    identity: Identity
    outcome: str
    interactions: int


def new_identity(*, serial: bool) -> Identity:
    """The identity of a new run."""
    return Identity(os.urandom(8).hex(), serial)


def write_identity(run: Path, identity: Identity) -> None:
    """Write it into the run's directory, where ``read_stopped_run`` finds it."""
    folder = run / CHECKPOINTS_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / IDENTITY_FILE, json.dumps(vars(identity)))


def read_identity(checkpoints: Path) -> Identity | None:
    """Of which run a folder of checkpoints is; None if that is not written there."""
    try:
        return msgspec.json.decode((checkpoints / IDENTITY_FILE).read_bytes(), type=Identity)
    except (OSError, ValueError):
        return None


def read_stopped_run(run: Path) -> StoppedRun:
    """The run in a directory.

    Raises:
        RunError: if there is none, or it kept no checkpoints.
    """
    run = run.resolve() if run.is_symlink() else run  # `latest`, which a resume points at the run
    _check_files(run)
    if not (run / CONFIG_FILE).exists():
        raise RunError(f"{run} holds no run to resume: there is no {CONFIG_FILE} in it")
    try:
        settings = read_toml(run / CONFIG_FILE)
        seed = settings.pop("seed")
        config = task_config(settings, source=str(run / CONFIG_FILE))
        told = json.loads((run / CHECKPOINTS_FOLDER / IDENTITY_FILE).read_text(encoding="utf-8"))
        identity = msgspec.convert(told, Identity)
    except FileNotFoundError:
        raise RunError(f"{run} cannot be resumed: it has kept no checkpoints, or they were deleted") from None
    except (KeyError, ValueError, OSError, ConfigError) as error:
        raise RunError(f"{run} cannot be resumed: {error}") from None
    summary = read_summary(run) if (run / SUMMARY_FILE).exists() else {}
    spent = int(summary.get("interactions_total", 0))
    return StoppedRun(run, config, int(seed), identity, str(summary.get("outcome") or ""), spent)


def _check_files(run: Path) -> None:
    try:
        check_own_files(run)
    except OSError as error:
        raise RunError(f"{run} cannot be resumed: {error}") from None


def checkpoint_folder(checkpoints: Path, place: str) -> Path:
    """Where the checkpoints of a sub-task's learner are; ``~p1`` is ``not-p1`` in file names."""
    name = place.replace("~", "not-")
    return checkpoints / (f"{name}-learner" if name in (COORDINATOR, SERIAL) else name)


def write_counts(checkpoints: Path, counts: State) -> None:
    """Replace the counts kept between checkpoints; not fsynced, so that it can be done every second."""
    fresh = checkpoints / f".{COUNTS_FILE}.new"
    with open_fresh(fresh) as file:
        file.write(json.dumps(counts))
    os.replace(fresh, checkpoints / COUNTS_FILE)


def read_counts(checkpoints: Path) -> Any:
    """The counts written last; None if there are none, or none that can be read."""
    try:
        return json.loads((checkpoints / COUNTS_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
