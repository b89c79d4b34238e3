"""Lists the code that a section ``[environment]`` names besides the package and installed environments."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

from t4nmtd_dist.core.config import EnvironmentConfig
from t4nmtd_dist.tasks import load_task, task_names
from t4nmtd_dist.tasks.given import is_given


def code_named(config: EnvironmentConfig) -> list[str]:
    """Code that opening the environment would import or call; empty if none of it can be foreign.

    Bundled ids name none, nor do plain ids, which gymnasium opens only if an installed package registered them. But a
    plain id with strings among its options counts, since installed environments accept module and file names (shimmy's
    ``env_id = "module:id"``, MuJoCo's ``xml_file``). Objects of this process (``tasks.given``) are the user's own.

    Returns:
        ``setting = value`` strings, with non-printable characters escaped.
    """
    bundled = config.id in bundled_ids() or is_given(config.id)
    text = any(isinstance(value, str) for value in _leaves(config.options))
    if (not config.labels or is_given(config.labels)) and (bundled or (":" not in config.id and not text)):
        return []
    settings = {"id": config.id, "labels": config.labels, "options": config.options}
    named = [f"environment.{key} = {value!r}" for key, value in settings.items() if value]
    return named + [f"environment.path = {folder!r}" for folder in config.folders]


@cache
def bundled_ids() -> frozenset[str]:
    """Environment ids of the bundled tasks."""
    return frozenset(load_task(name).environment.id for name in task_names())


def _leaves(options: Mapping[str, Any]) -> Iterator[Any]:
    """All values of nested options; keys only name arguments."""
    left: list[Any] = [options]
    while left:
        value = left.pop()
        if isinstance(value, Mapping):
            left.extend(value.values())
        elif isinstance(value, list | tuple):
            left.extend(value)
        else:
            yield value
