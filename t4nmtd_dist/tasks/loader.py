"""Finds a task by name or path and completes its settings."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path

from t4nmtd_dist.core.config import EnvironmentConfig, TaskConfig, task_config
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.tasks.layers import Layer, merged, setting_layers


def task_names() -> list[str]:
    """Names of the bundled tasks."""
    found = files("t4nmtd_dist.tasks").iterdir()
    return sorted(entry.name.removesuffix(".toml") for entry in found if entry.name.endswith(".toml"))


def load_task(
    name: str, *, configs: Iterable[Path] = (), flags: Iterable[str] = (), preset: str = "", method: str = ""
) -> TaskConfig:
    """The settings of a task.

    Args:
        name: a name such as ``task7``, or the path of a task file of your own (``*.toml``).
        method: name of a method laid over the task file before all others (``tasks.methods``).
        preset: name of settings laid over them (``tasks.presets``).
        configs: further TOML files laid over the task file, in order.
        flags: ``section.key=value`` texts laid over everything.

    Raises:
        ConfigError: for an unknown task, an unreadable file, or settings that ``task_config`` refuses.
    """
    return from_layers(name, setting_layers(task_file(name), configs, flags, preset=preset, method=method))


def from_layers(name: str, layers: Iterable[Layer]) -> TaskConfig:
    """Settings of task ``name`` from its layers; see ``load_task``."""
    task = task_config(merged(layers), source=name)
    return _with_path(task, task_file(name).parent) if name.endswith(".toml") else task


def is_bundled(task: TaskConfig) -> bool:
    """Whether the task has the name, environment and options of a bundled task."""
    return task.name in task_names() and task.environment == load_task(task.name).environment


def is_packages_environment(environment: EnvironmentConfig) -> bool:
    """Whether the environment comes with the package, with any options."""
    return environment.id in {load_task(name).environment.id for name in task_names()}


def _with_path(task: TaskConfig, folder: Path) -> TaskConfig:
    """The task with absolute module folders: the task file's own, then those of ``environment.path``."""
    listed = [folder, *(folder / further for further in task.environment.folders)]
    absolute = tuple(dict.fromkeys(str(path.resolve()) for path in listed))
    path = absolute if len(absolute) > 1 else absolute[0]
    return dataclasses.replace(task, environment=dataclasses.replace(task.environment, path=path))


def task_file(name: str) -> Path:
    """The task file for a name or path.

    Raises:
        ConfigError: if no task has that name; suggests the nearest.
    """
    if name.endswith(".toml"):
        return Path(name)
    known = task_names()
    if name not in known:
        nearest = difflib.get_close_matches(name, known, n=1, cutoff=0)
        raise ConfigError(
            f"unknown task {name!r}; did you mean {nearest[0]!r}? "
            f"Known: {', '.join(known)}, or the path of a task file that ends in .toml"
        )
    return Path(str(files("t4nmtd_dist.tasks") / f"{name}.toml"))
