"""``t4nmtd config``: a task's resolved settings as TOML, with the source of each value."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import tomli_w

from t4nmtd_dist.core.config import TaskConfig, learner_defaults
from t4nmtd_dist.core.registry import AGENTS
from t4nmtd_dist.tasks.layers import DEFAULT, Key, Layer, origin


def settings_text(config: TaskConfig, layers: Sequence[Layer]) -> str:
    """TOML for ``--config`` with a comment on every line, and the sections of the chosen agent and method only.

    With algorithm ``auto`` it includes every agent's section, and comments out settings that agents have own defaults
    for, because a file would override those.

    Args:
        config: the settings.
        layers: their sources (``tasks.layers``).
    """
    chosen = config.learner.algorithm
    others = AGENTS.modules.keys() - {chosen} if chosen != "auto" else set()
    others |= config.methods.keys() - {config.learner.method}
    data = {name: value for name, value in config.to_dict().items() if name not in others}
    return "\n".join(_table(data, (), config, layers)) + "\n"


def _table(data: Mapping[str, Any], path: Key, config: TaskConfig, layers: Sequence[Layer]) -> Iterator[str]:
    """Lines of a table and its nested tables."""
    tables = {name: value for name, value in data.items() if isinstance(value, Mapping) and value}
    if path:
        yield ""
        yield f"[{'.'.join(map(_key, path))}]"
    for name, value in data.items():
        if name not in tables:
            yield _setting((*path, name), value, config, layers)
    for name, table in tables.items():
        yield from _table(table, (*path, name), config, layers)


def _setting(path: Key, value: Any, config: TaskConfig, layers: Sequence[Layer]) -> str:
    comes_from = origin(path, layers, config)
    line = f"{_key(path[-1])} = {_value(value, multiline=True)}  # {comes_from}"
    own = _defaults_of_agents(path) if config.learner.algorithm == "auto" and comes_from == DEFAULT else {}
    return "; ".join([f"# {line}", *(f"{name}: {_value(default)}" for name, default in own.items())]) if own else line


def _defaults_of_agents(path: Key) -> dict[str, Any]:
    """Agents' own defaults for a setting of ``[learner]``."""
    section, name = path[0], path[-1]
    defaults = {agent: learner_defaults(agent) for agent in AGENTS.modules} if section == "learner" else {}
    return {agent: own[name] for agent, own in defaults.items() if name in own}


def _value(value: Any, *, multiline: bool = False) -> str:
    """A value as TOML, on one line if possible."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(name)} = {_value(each)}" for name, each in value.items()) + "}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    multiline = multiline and isinstance(value, str) and "\r" not in value
    return tomli_w.dumps({"v": value}, multiline_strings=multiline).removeprefix("v = ").removesuffix("\n")


def _key(name: str) -> str:
    return tomli_w.dumps({name: 0}).removesuffix(" = 0\n")
