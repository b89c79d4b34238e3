"""Presets: settings laid over any task file, by name; each is a TOML file in this folder."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.core.setting_sources import merge, read_toml

BUNDLED_ENVIRONMENTS = "envs:t4nmtd/"


def preset_names() -> list[str]:
    """Names of all presets."""
    found = files(__name__).iterdir()
    return sorted(entry.name.removesuffix(".toml") for entry in found if entry.name.endswith(".toml"))


def preset_settings(name: str, task: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a preset for a task, as TOML gives them.

    What a preset says of an environment holds for the bundled ones only. Its section ``learner_with`` has settings of
    ``learner`` that depend on the algorithm that the task names.

    Args:
        name: of the preset.
        task: the task's settings.

    Raises:
        ConfigError: if there is no such preset.
    """
    known = preset_names()
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        advice = f"did you mean {near[0]!r}? " if near else ""
        raise ConfigError(f"unknown preset {name!r}; {advice}Known: {', '.join(known)}")
    settings = read_toml(Path(str(files(__name__) / f"{name}.toml")))
    if not _text(task, "environment", "id").startswith(BUNDLED_ENVIRONMENTS):
        settings.pop("environment", None)
    own = settings.pop("learner_with", {}).get(_text(task, "learner", "algorithm"), {})
    return merge(settings, {"learner": own})


def _text(data: Mapping[str, Any], section: str, key: str) -> str:
    found = data.get(section)
    value = found.get(key, "") if isinstance(found, Mapping) else ""
    return value if isinstance(value, str) else ""
