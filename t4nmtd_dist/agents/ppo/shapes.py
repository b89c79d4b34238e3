"""Names and shapes of PPO's parameters. Imports no torch."""

from __future__ import annotations

from collections.abc import Sequence

from t4nmtd_dist.agents.weights import Shapes, mlp_shapes
from t4nmtd_dist.core.config import TaskConfig


def parameter_shapes(config: TaskConfig, inputs: int, actions: int) -> Shapes:
    """See ``protocol.AgentShapes``."""
    hidden = config.learner.hidden
    return mlp_shapes("actor", inputs, hidden, actions) | mlp_shapes("critic", inputs, hidden, 1)


def size_parameters(hidden: Sequence[int]) -> tuple[str, str]:
    """See ``protocol.AgentShapes``."""
    return "actor.0.weight", f"actor.{2 * len(hidden)}.bias"
