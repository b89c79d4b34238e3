"""Settings of a method chosen by name, and the list of methods."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from t4nmtd_dist.core.agent_settings import agent_for, agent_settings, suits
from t4nmtd_dist.core.registry import AGENTS, METHODS


def method_settings(name: str, task: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that ``--method NAME`` lays over a task's.

    They choose the method and, if the method cannot use the task's agent, the first one for the same actions that it
    can use.

    Args:
        name: of the method.
        task: the task's settings, as in TOML.

    Raises:
        ConfigError: if there is no such method.
    """
    METHODS.check(name, "--method")
    section = task.get("learner")
    agent = section.get("algorithm") if isinstance(section, Mapping) else None
    if not isinstance(agent, str) or agent not in AGENTS.modules or suits(agent, name):
        return {"learner": {"method": name}}
    return {"learner": {"method": name, "algorithm": agent_for(agent_settings(agent).actions, name)}}


def method_titles() -> dict[str, str]:
    """A line about every method, by name."""
    return {name: (METHODS.module(name).__doc__ or "").splitlines()[0] for name in METHODS.names()}
