"""Settings of the registered agents, found by name: each declares its own in ``agents/<name>/config.py``.

Such a module defines

- ``CONFIG``: a frozen dataclass, the section ``[<name>]`` of a task file;
- ``ACTIONS``: the action spaces it takes, ``"discrete"`` or ``"continuous"``;
- ``EXPLORATION`` (optional): settings to raise for more exploration, as ``section.key``;
- ``LEARNER_DEFAULTS`` (optional): its own defaults for keys of ``[learner]``;
- ``FORMER_KEYS`` (optional): keys of earlier versions and what to use instead;
- ``check(config, learner)`` (optional): conditions on several settings; raises ConfigError.

It imports no torch: every task file that is read imports it.
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
    """What an agent's ``config`` module declares; see the module docstring."""

    config: type
    actions: ActionKind
    learner_defaults: Mapping[str, Any]
    former_keys: Mapping[str, str]
    exploration: tuple[str, ...]
    check: Callable[[Any, Any], None]


@cache
def agent_settings(name: str) -> AgentSettings:
    """What the agent ``name`` declares.

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
    """The check of an agent that declares none."""


def default_sections() -> dict[str, Any]:
    """The section of every registered agent, with its defaults."""
    return {name: agent_settings(name).config() for name in AGENTS.modules}


def agent_for(actions: ActionKind) -> str:
    """The agent that ``auto`` chooses: the first of the registry that takes these actions."""
    return next(name for name in AGENTS.modules if agent_settings(name).actions == actions)
