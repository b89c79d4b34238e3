"""Imports the modules of an agent's folder on demand, by algorithm name."""

from __future__ import annotations

from types import ModuleType
from typing import cast

from t4nmtd_dist.agents.protocol import AgentActor, AgentBuilder, AgentShapes, OffPolicyBuilder
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.core.registry import AGENTS


def shapes_module(algorithm: str) -> AgentShapes:
    """The agent's ``shapes`` module: parameter names and shapes; imports no torch.

    Raises:
        ConfigError: if no agent has that name, or the algorithm is still ``"auto"``.
    """
    return cast(AgentShapes, _module(algorithm, "shapes"))


def actor_module(algorithm: str) -> AgentActor:
    """The agent's ``actor`` module, which builds an actor from weights.

    Raises:
        ConfigError: as for ``shapes_module``.
    """
    return cast(AgentActor, _module(algorithm, "actor"))


def builder_module(algorithm: str) -> AgentBuilder:
    """The agent's ``agent`` module, which builds learners.

    Raises:
        ConfigError: as for ``shapes_module``.
    """
    return cast(AgentBuilder, _module(algorithm, "agent"))


def off_policy_module(algorithm: str) -> OffPolicyBuilder:
    """The ``agent`` module of an off-policy agent.

    Raises:
        ConfigError: as for ``shapes_module``.
    """
    return cast(OffPolicyBuilder, _module(algorithm, "agent"))


def _module(algorithm: str, part: str) -> ModuleType:
    if algorithm == "auto":
        raise ConfigError('learner.algorithm = "auto" is not decided yet: pass the task through prepared() first')
    AGENTS.check(algorithm, "learner.algorithm")
    return AGENTS.module(algorithm, part)
