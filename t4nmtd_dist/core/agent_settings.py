"""Settings of the registered agents; each agent declares its own in ``agents/<name>/config.py``.

Such a module defines
- ``CONFIG``: a frozen dataclass, the section ``[<name>]`` of a task file;
- ``ACTIONS``: supported actions, ``"discrete"`` or ``"continuous"``;
- ``OFF_POLICY`` (optional): whether it learns from a replay buffer; False by default;
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

from t4nmtd_dist.core.registry import AGENTS, METHODS

ActionKind = Literal["discrete", "continuous"]


@dataclass(frozen=True)
class AgentSettings:
    """Declarations of an agent's ``config`` module; see the module docstring."""

    config: type
    actions: ActionKind
    off_policy: bool
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
        off_policy=getattr(module, "OFF_POLICY", False),
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


def suits(agent: str, method: str) -> bool:
    """Whether a method can use an agent: one whose roles share an environment needs off-policy agents."""
    return agent_settings(agent).off_policy or not getattr(METHODS.module(method), "SHARES_ENV", False)


def agent_for(actions: ActionKind, method: str) -> str:
    """The agent chosen by ``auto``: the first registered one that supports these actions and suits the method."""
    return next(name for name in AGENTS.modules if agent_settings(name).actions == actions and suits(name, method))
