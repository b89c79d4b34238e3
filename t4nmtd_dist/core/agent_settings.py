"""Settings of the registered agents; each agent declares its own in ``agents/<name>/config.py``.

Such a module defines
- ``CONFIG``: a frozen dataclass, the section ``[<name>]`` of a task file;
- ``ACTIONS``: supported actions, ``"discrete"`` or ``"continuous"``;
- ``EXPLORATION`` (optional): settings to raise for more exploration, as ``section.key``;
- ``LEARNER_DEFAULTS`` (optional): defaults for keys of ``[learner]``;
- ``FORMER_KEYS`` (optional): former keys and their replacements;
- ``check(config, learner)`` (optional): conditions on several settings; raises ConfigError.

It imports no torch, since reading any task file imports it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

from t4nmtd_dist.core.registry import AGENTS

ActionKind = Literal["discrete", "continuous"]


@dataclass(frozen=True)
class AgentSettings:
    """Declarations of an agent's ``config`` module; see the module docstring."""

    config: type
    actions: ActionKind
    learner_defaults: Mapping[str, Any]
    former_keys: Mapping[str, str]
    exploration: tuple[str, ...]
    check: Callable[[Any, Any], None]


@cache
def agent_settings(name: str) -> AgentSettings:
    """Declarations of agent ``name``.

    Raises:
        ConfigError: if the name is unknown.
    """
    module = AGENTS.module(name, "config")
    return AgentSettings(
        config=module.CONFIG,
        actions=module.ACTIONS,
        learner_defaults=getattr(module, "LEARNER_DEFAULTS", {}),
        former_keys=getattr(module, "FORMER_KEYS", {}),
        exploration=getattr(module, "EXPLORATION", ()),
        check=getattr(module, "check", _nothing_to_check),
    )


def _nothing_to_check(config: Any, learner: Any) -> None:
    """Default check of an agent."""


def default_sections() -> dict[str, Any]:
    """The default section of every registered agent."""
    return {name: agent_settings(name).config() for name in AGENTS.modules}


def agent_for(actions: ActionKind) -> str:
    """The agent chosen by ``auto``: the first registered one that supports these actions."""
    return next(name for name in AGENTS.modules if agent_settings(name).actions == actions)
