"""Settings of the registered methods; a method's module may declare its own.

``CONFIG``, a frozen dataclass, is the section ``[<name>]`` of a task file, and ``TaskConfig.method`` its settings.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

from t4nmtd_dist.core.registry import METHODS


@cache
def method_configs() -> Mapping[str, type]:
    """The ``CONFIG`` of every method that has one."""
    found = {name: getattr(METHODS.module(name), "CONFIG", None) for name in METHODS.modules}
    return {name: config for name, config in found.items() if config is not None}


def default_sections() -> dict[str, Any]:
    """The default section of every method that has settings."""
    return {name: config() for name, config in method_configs().items()}
