"""Which code a section ``[environment]`` names beside the package's own and installed environments."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

from t4nmtd_dist.core.config import EnvironmentConfig
from t4nmtd_dist.tasks import load_task, task_names
from t4nmtd_dist.tasks.given import is_given


def code_named(config: EnvironmentConfig) -> list[str]:
    """What opening the environment would import or call; empty if none of it can be a stranger's.

    Nothing can be where the id is that of a bundled task, or a plain id, which gymnasium opens only if an installed
    package has registered it. A plain id with text among its options counts as naming code: installed environments
    take names of modules and of files (shimmy's ``env_id = "module:id"``, MuJoCo's ``xml_file``). Objects of this
    process (``tasks.given``) are the user's own.

    Returns:
        One ``setting = value`` each, with every character that is not printable escaped.
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
    """Ids of the environments of the tasks that come with the package."""
    return frozenset(load_task(name).environment.id for name in task_names())


def _leaves(options: Mapping[str, Any]) -> Iterator[Any]:
    """All values of options, however deep; keys only name arguments."""
    left: list[Any] = [options]
    while left:
        value = left.pop()
        if isinstance(value, Mapping):
            left.extend(value.values())
        elif isinstance(value, list | tuple):
            left.extend(value)
        else:
            yield value
