"""The modules of an agent's folder, by the name of its algorithm; imported when they are first asked for."""

from __future__ import annotations

from types import ModuleType
from typing import cast

from t4nmtd_dist.agents.protocol import AgentActor, AgentBuilder, AgentShapes
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.core.registry import AGENTS


def shapes_module(algorithm: str) -> AgentShapes:
    """The agent's names and shapes of parameters; imports no torch.

    Raises:
        ConfigError: if no agent has that name, or the algorithm is not decided yet.
    """
    return cast(AgentShapes, _module(algorithm, "shapes"))


def actor_module(algorithm: str) -> AgentActor:
    """What rebuilds the agent's actor from weights.

    Raises:
        ConfigError: as for ``shapes_module``.
    """
    return cast(AgentActor, _module(algorithm, "actor"))


def builder_module(algorithm: str) -> AgentBuilder:
    """What builds the agent's learners.

    Raises:
        ConfigError: as for ``shapes_module``.
    """
    return cast(AgentBuilder, _module(algorithm, "agent"))


def _module(algorithm: str, part: str) -> ModuleType:
    if algorithm == "auto":
        raise ConfigError('learner.algorithm = "auto" is not decided yet: pass the task through prepared() first')
    AGENTS.check(algorithm, "learner.algorithm")
    return AGENTS.module(algorithm, part)
