"""Layers of a task's settings, and the origin of each setting."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

from t4nmtd_dist.core.config import TaskConfig, learner_defaults
from t4nmtd_dist.core.setting_sources import merge, read_toml, settings_from_flags
from t4nmtd_dist.tasks.methods import method_settings
from t4nmtd_dist.tasks.presets import preset_settings

DEFAULT = "default"

Key = tuple[str, ...]


@dataclass(frozen=True)
class Layer:
    """Settings from one source.

    Attributes:
        origin: a file or flag, for display.
        data: nested mappings, as in TOML.
    """

    origin: str
    data: Mapping[str, Any]


def setting_layers(
    task: Path, configs: Iterable[Path] = (), flags: Iterable[str] = (), *, preset: str = "", method: str = ""
) -> list[Layer]:
    """A task file, a method, a preset, files laid over them and ``--set`` flags, the lowest layer first.

    Raises:
        ConfigError: if a file cannot be read, a flag is malformed, or there is no such preset or method.
    """
    layers = [Layer(task.name, read_toml(task))]
    if method:
        layers.append(Layer(f"--method {method}", method_settings(method, merged(layers))))
    if preset:
        layers.append(Layer(f"--preset {preset}", preset_settings(preset, merged(layers))))
    files = [Layer(f"--config {path}", read_toml(path)) for path in configs]
    return [*layers, *files, Layer("--set", settings_from_flags(flags))]


def merged(layers: Iterable[Layer]) -> dict[str, Any]:
    """The merged layers."""
    return reduce(merge, (layer.data for layer in layers), {})


def origin(key: Key, layers: Iterable[Layer], config: TaskConfig) -> str:
    """Origin of a setting's value: a layer, the chosen algorithm's defaults, or the general ones."""
    for layer in reversed(list(layers)):
        if _has(layer.data, key):
            return layer.origin
    if key == ("environment", "path") and config.environment.path:
        return "folder of the task file"
    algorithm = config.learner.algorithm
    own = {"learner": learner_defaults(algorithm)}
    return f"{DEFAULT} of {algorithm}" if _has(own, key) else DEFAULT


def _has(data: Any, key: Key) -> bool:
    for name in key:
        if not isinstance(data, Mapping) or name not in data:
            return False
        data = data[name]
    return True
