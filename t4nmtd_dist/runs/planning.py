"""Turns options into a plan: a new run, or the resume of a stopped one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from t4nmtd_dist.core.config import TaskConfig, task_config
from t4nmtd_dist.core.errors import ConfigError, RunError
from t4nmtd_dist.core.setting_sources import merge, read_toml, settings_from_flags
from t4nmtd_dist.environments.trust import remember_own, require_trust
from t4nmtd_dist.runs.directory import default_run_directory, real_path
from t4nmtd_dist.runs.event_files import check_tensorboard
from t4nmtd_dist.runs.options import RunOptions
from t4nmtd_dist.runs.resuming import Identity, StoppedRun, new_identity, read_stopped_run
from t4nmtd_dist.tasks import load_task
from t4nmtd_dist.tasks.methods import method_settings
from t4nmtd_dist.tasks.presets import preset_settings

Warn = Callable[[str], object]


@dataclass(frozen=True)
class RunPlan:
    """A run to start or resume.

    Attributes:
        seed: of networks, exploration and environments.
        identity: constant across resumes.
        stopped: the run to resume, if any.
    """

    config: TaskConfig
    seed: int
    directory: Path
    identity: Identity
    stopped: StoppedRun | None = None

    @property
    def resumes(self) -> bool:
        """Whether it resumes a stopped run."""
        return self.stopped is not None

    @property
    def solved(self) -> str:
        """A message that the run is already solved; "" if it is not."""
        if self.stopped is None or self.stopped.outcome != "solved":
            return ""
        return f"the run in {self.directory} has solved {self.config.name} already: there is nothing to go on with"


def plan_run(options: RunOptions, *, serial: bool = False, warn: Warn = print) -> RunPlan:
    """Plan what the options request.

    Args:
        options: from the user.
        serial: whether all roles share one process.
        warn: logs each tolerable damage to the resumed run.

    Raises:
        ConfigError: if they contradict each other or the resumed run; see also ``load_task``.
        RunError: if the run cannot be resumed.
        TrustError: if the resumed run names untrusted code.
    """
    check_tensorboard(options.tensorboard)
    if not options.checkpoint_every > 0:
        raise ConfigError(f"--checkpoint-every {options.checkpoint_every}: expected seconds above 0")
    if options.resume is not None:
        if options.transfer_from is not None:
            raise ConfigError("--transfer-from begins a run and --resume goes on with one: give one of them")
        return _resumed(options, options.resume, serial, warn)
    if not options.task:
        raise ConfigError("expected --task NAME for a new run, or --resume RUN to go on with one")
    return plan_task(
        load_task(
            options.task, configs=options.config, flags=options.set, preset=options.preset, method=options.method
        ),
        options,
        serial=serial,
    )


def plan_task(config: TaskConfig, options: RunOptions, *, serial: bool = False) -> RunPlan:
    """Plan a new run of a task.

    Args:
        config: its settings.
        options: for budget, seed and folder.
        serial: whether all roles share one process.

    Raises:
        ConfigError: for a negative seed or a budget out of range.
    """
    if options.max_interactions is not None:
        config = dataclasses.replace(config, max_interactions=options.max_interactions)
    seed = options.seed or 0
    if seed < 0:
        raise ConfigError(f"--seed {seed}: expected 0 or more")
    remember_own(config.environment)
    directory = real_path(options.run_dir or default_run_directory(config.name, seed))
    return RunPlan(config, seed, directory, new_identity(serial=serial))


def _flags(options: RunOptions) -> list[str]:
    budget = options.max_interactions
    return [*options.set, *([] if budget is None else [f"max_interactions={budget}"])]


def _resumed(options: RunOptions, run: Path, serial: bool, warn: Warn) -> RunPlan:
    stopped = read_stopped_run(run)
    for text in stopped.warnings:
        warn(text)
    _check_same_run(options, stopped, serial)
    config = _check_same_settings(options, stopped)
    if stopped.outcome == "budget spent" and config.max_interactions <= stopped.interactions:
        raise RunError(
            f"the run in {run} has spent its budget of {stopped.config.max_interactions} interactions; give it more "
            "with --max-interactions"
        )
    require_trust(config.environment, f"the run in {run}", given=options.trust)
    return RunPlan(config, stopped.seed, stopped.path, stopped.identity, stopped)


def _check_same_run(options: RunOptions, stopped: StoppedRun, serial: bool) -> None:
    if options.restart:
        raise ConfigError("--resume goes on with a run and --restart deletes it: give one of them")
    if options.run_dir is not None and options.run_dir.resolve() != stopped.path.resolve():
        raise ConfigError(f"--run-dir {options.run_dir} is not the run to resume, {stopped.path}; leave it out")
    if options.seed not in (None, stopped.seed):
        raise ConfigError(f"--seed {options.seed}: the run to resume has seed {stopped.seed}; leave it out")
    if options.task and load_task(options.task).name != stopped.config.name:
        raise ConfigError(f"--task {options.task}: the run to resume is of {stopped.config.name}; leave it out")
    if stopped.identity.serial != serial:
        how = "with --serial" if stopped.identity.serial else "without --serial"
        raise ConfigError(f"the run in {stopped.path} was begun {how}, and can be resumed only {how}")


def _check_same_settings(options: RunOptions, stopped: StoppedRun) -> TaskConfig:
    """The run's settings, with the requested budget and time limit."""
    own = stopped.config.to_dict()
    asked: Mapping[str, Any] = own
    if options.method:
        asked = merge(asked, method_settings(options.method, own))
    if options.preset:
        asked = merge(asked, preset_settings(options.preset, own))
    for path in options.config:
        asked = merge(asked, read_toml(path))
    config = task_config(merge(asked, settings_from_flags(_flags(options))), source="--resume")
    if config.max_interactions < stopped.config.max_interactions:
        raise ConfigError(
            f"--max-interactions {config.max_interactions}: the run to resume has a budget of "
            f"{stopped.config.max_interactions}, which can only be raised"
        )
    time_limit = stopped.config.decomposition.time_limit
    same = dataclasses.replace(
        config,
        max_interactions=stopped.config.max_interactions,
        decomposition=dataclasses.replace(config.decomposition, time_limit=time_limit),
    )
    wanted = same.to_dict()
    for key, value in _differences(own, wanted):
        raise ConfigError(
            f"{key} = {value!r} contradicts the run to resume, whose settings stay as they are; begin a new run for it"
        )
    return config


def _differences(own: Mapping[str, Any], wanted: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in wanted.items():
        held = own.get(key)
        if isinstance(value, Mapping) and isinstance(held, Mapping):
            yield from _differences(held, value, f"{path}{key}.")
        elif value != held:
            yield f"{path}{key}", value
