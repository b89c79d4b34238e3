"""What a resume needs: the run's identity, settings and checkpoint folders."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

import msgspec

from t4nmtd_dist.core.config import TaskConfig, task_config
from t4nmtd_dist.core.errors import ConfigError, RunError
from t4nmtd_dist.core.setting_sources import read_toml
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.runs.counts import described, read_counts
from t4nmtd_dist.runs.directory import (
    CHECKPOINTS_FOLDER,
    CONFIG_FILE,
    RUN_FORMAT,
    SUMMARY_FILE,
    check_own_files,
    read_summary,
    write_atomically,
)
from t4nmtd_dist.runs.file_names import file_name

IDENTITY_FILE = "run.json"
CHECKPOINT_EVERY_S = 300.0
COORDINATOR, SERIAL = "coordinator", "serial"


@dataclass(frozen=True)
class Identity:
    """What stays the same across resumes.

    Attributes:
        run_id: random; a resume ignores checkpoints of other runs.
        serial: whether it runs in lock-step in one process.
    """

    run_id: str
    serial: bool


@dataclass(frozen=True)
class StoppedRun:
    """A run directory to resume.

    Attributes:
        config: its settings and budget.
        outcome: how it ended; "" if it was killed.
        interactions: from its summary, or its counts if that is damaged; 0 without a summary.
        warnings: tolerable damage.
    """

    path: Path
    config: TaskConfig
    seed: int
    identity: Identity
    outcome: str
    interactions: int
    warnings: tuple[str, ...] = ()


def new_identity(*, serial: bool) -> Identity:
    """The identity of a new run."""
    return Identity(os.urandom(8).hex(), serial)


def write_identity(run: Path, identity: Identity) -> None:
    """Write the identity to where ``read_stopped_run`` finds it."""
    folder = run / CHECKPOINTS_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / IDENTITY_FILE, json.dumps(vars(identity)))


def read_identity(checkpoints: Path) -> Identity | None:
    """The run that a checkpoint folder belongs to; None if unknown."""
    try:
        return msgspec.json.decode((checkpoints / IDENTITY_FILE).read_bytes(), type=Identity)
    except (OSError, ValueError):
        return None


def read_stopped_run(run: Path) -> StoppedRun:
    """Read the run in a directory.

    Raises:
        RunError: if there is none, its format is another version's, or it has no checkpoints.
    """
    run = run.resolve() if run.is_symlink() else run  # `latest`, which a resume repoints
    _check_files(run)
    if not (run / CONFIG_FILE).exists():
        raise RunError(f"{run} holds no run to resume: there is no {CONFIG_FILE} in it")
    try:
        settings = read_toml(run / CONFIG_FILE)
        _check_format(run, settings.pop("run_format", 1))
        seed = settings.pop("seed")
        config = task_config(settings, source=str(run / CONFIG_FILE))
        told = json.loads((run / CHECKPOINTS_FOLDER / IDENTITY_FILE).read_text(encoding="utf-8"))
        identity = msgspec.convert(told, Identity)
    except FileNotFoundError:
        raise RunError(f"{run} cannot be resumed: it has kept no checkpoints, or they were deleted") from None
    except (KeyError, ValueError, OSError, ConfigError) as error:
        raise RunError(f"{run} cannot be resumed: {error}") from None
    return _with_end(run, config, int(seed), identity)


def _check_format(run: Path, found: object) -> None:
    if found != RUN_FORMAT:
        raise RunError(
            f"{run} cannot be resumed: another version of T4NMTD-dist made it (run format {found!r}; this version "
            f"resumes {RUN_FORMAT}). Its policy still loads (t4nmtd evaluate {run}); begin a new run to train further"
        )


def _with_end(run: Path, config: TaskConfig, seed: int, identity: Identity) -> StoppedRun:
    """Add how the run ended, from its summary or counts."""
    if not (run / SUMMARY_FILE).exists():
        return StoppedRun(run, config, seed, identity, "", 0)
    try:
        summary = read_summary(run)
        outcome, spent = summary["outcome"], summary["interactions_total"]
        if not (isinstance(outcome, str | None) and isinstance(spent, int) and spent >= 0):
            raise RunError(f"{run / SUMMARY_FILE} is damaged: outcome = {outcome!r}, interactions_total = {spent!r}")
    except (RunError, KeyError) as error:
        counts = read_counts(run / CHECKPOINTS_FOLDER) or {}
        spent = sum(total["interactions"] for total in counts.get("totals", {}).values())
        told = f"{run / SUMMARY_FILE} is damaged ({described(error)}); going on without it"
        return StoppedRun(run, config, seed, identity, _outcome(run, counts), spent, (told,))
    return StoppedRun(run, config, seed, identity, outcome or "", spent)


def _outcome(run: Path, counts: State) -> str:
    """The outcome in a run's counts; "" for a solved run that has not written its result."""
    outcome = str(counts.get("outcome") or "")
    return "" if outcome == "solved" and (run / CHECKPOINTS_FOLDER / COORDINATOR).exists() else outcome


def _check_files(run: Path) -> None:
    try:
        check_own_files(run)
    except OSError as error:
        raise RunError(f"{run} cannot be resumed: {error}") from None


def checkpoint_folder(checkpoints: Path, place: str) -> Path:
    """The checkpoint folder of a sub-task's learner."""
    name = file_name(place)
    return checkpoints / (f"{name}-learner" if name in (COORDINATOR, SERIAL) else name)
