"""A task as a Python object: formula, environment and labelling function, or a task file."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import gymnasium

from t4nmtd_dist.automata.formula import names_in_order, parse
from t4nmtd_dist.core.config import TaskConfig, task_config
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.core.setting_sources import merge
from t4nmtd_dist.tasks import from_layers, task_file
from t4nmtd_dist.tasks.given import give, is_given
from t4nmtd_dist.tasks.layers import Layer, setting_layers

EnvFactory = Callable[..., gymnasium.Env[Any, Any]]
Labels = Callable[[Any, dict[str, Any]], Any]
Settings = Mapping[str, Any]


class Task:
    """A task to train; equivalent to a task file.

    Example::

        task = Task(formula="F(left & X(F(flag))) & G(!wall)", env=make, labels=labels, horizon=40)
        result = train(task)

    Args:
        formula: LTLf over the propositions.
        env: a function that creates the environment, or a registered Gymnasium id.
        labels: maps a step's observation (as the environment returned it) and info to the names that hold; default
            ``info["labels"]``.
        horizon: steps of an evaluated episode; required unless the id is registered with a limit.
        propositions: all reportable names; by default those in the formula.
        name: for the run directory.
        settings: other task-file settings, nested or with dotted keys: ``{"learner.gamma": 0.95}``.

    Attributes:
        config: the settings with all defaults.

    Raises:
        ConfigError: for an unknown setting, one out of range, or a missing horizon.
        FormulaError: if the formula cannot be parsed, or uses an undeclared name.
    """

    config: TaskConfig

    def __init__(
        self,
        formula: str,
        env: EnvFactory | str,
        *,
        labels: Labels | None = None,
        horizon: int | None = None,
        propositions: Sequence[str] | None = None,
        name: str = "task",
        settings: Settings | None = None,
    ) -> None:
        functions = [function for function in (env, labels) if callable(function)]
        environment = {
            "id": env if isinstance(env, str) else _setting(env),
            "labels": "" if labels is None else _setting(labels),
            "horizon": horizon or _registered_limit(env),
            "path": _folders(functions),
        }
        names = names_in_order(formula) if propositions is None else propositions
        parse(formula, names)
        data = {"name": name, "formula": formula, "propositions": list(names), "environment": environment}
        self.config = task_config(merge(data, _nested(settings or {})), source=f"task {name!r}")

    @classmethod
    def load(
        cls, name: str | PathLike[str], settings: Settings | None = None, *, preset: str = "", method: str = ""
    ) -> Task:
        """A bundled task (``"task7"``), or the task of a file (``"my_task.toml"``).

        Args:
            name: name or path.
            settings: override those of the file and of the preset.
            preset: name of settings that override those of the file; ``paper`` is the method as published.
            method: name of the method that learns, such as ``crm``, with an agent that it can use.

        Raises:
            ConfigError: if there is no such task, or a setting is wrong.
        """
        below = setting_layers(task_file(str(name)), preset=preset, method=method)
        layers = [*below, Layer("settings", _nested(settings or {}))]
        return cls.of(from_layers(str(name), layers))

    @classmethod
    def of(cls, config: TaskConfig) -> Task:
        """The task with these settings."""
        task = cls.__new__(cls)
        task.config = config
        return task

    @property
    def needs_this_process(self) -> bool:
        """Whether other programs cannot import its functions."""
        environment = self.config.environment
        return is_given(environment.id) or is_given(environment.labels)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Task) and self.config == other.config

    def __hash__(self) -> int:
        return hash((self.config.name, self.config.formula))

    def __repr__(self) -> str:
        return f"Task({self.config.name!r}, {self.config.formula!r}, env={self.config.environment.id!r})"


def _nested(settings: Settings) -> dict[str, Any]:
    """Expand dotted keys: {"learner.gamma": 0.9} -> {"learner": {"gamma": 0.9}}."""
    nested: dict[str, Any] = {}
    for key, value in settings.items():
        first, dot, rest = key.partition(".")
        inner = _nested({rest: value}) if dot else _nested(value) if isinstance(value, Mapping) else value
        nested = merge(nested, {first: inner})
    return nested


def _setting(function: Callable[..., Any]) -> str:
    """``module:name`` if importable elsewhere; otherwise a name valid in this process."""
    module, name = getattr(function, "__module__", None), getattr(function, "__qualname__", "")
    loaded = sys.modules.get(module or "")
    importable = module not in (None, "__main__") and getattr(loaded, name, None) is function
    return f"{module}:{name}" if importable else give(function)


def _folders(functions: Sequence[Callable[..., Any]]) -> list[str]:
    """Folders of importable functions' modules, for other processes."""
    folders = []
    for function in functions:
        module = sys.modules.get(getattr(function, "__module__", ""))
        file = getattr(module, "__file__", None)
        if module is None or file is None or is_given(_setting(function)):
            continue
        levels = module.__name__.count(".") + (Path(file).name == "__init__.py")
        folders.append(str(Path(file).resolve().parents[levels]))
    return list(dict.fromkeys(folders))


def _registered_limit(env: EnvFactory | str) -> int:
    """The registered time limit of an id.

    Raises:
        ConfigError: if there is none.
    """
    plain = env.rpartition(":")[2] if isinstance(env, str) else ""
    limit = gymnasium.registry[plain].max_episode_steps if plain in gymnasium.registry else None
    if limit is None:
        raise ConfigError(f"horizon is missing: {env!r} has no registered time limit; pass horizon=STEPS")
    return limit
