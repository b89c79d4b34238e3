"""Sizes of SAC's networks, and names and shapes of their parameters. Imports no torch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from t4nmtd_dist.agents.weights import Shapes
from t4nmtd_dist.core.config import TaskConfig


@dataclass(frozen=True)
class StackShape:
    """Sizes of a stack: ``count`` networks of one shape with the same inputs.

    Attributes:
        inputs: length of the input.
        hidden: hidden layer widths, at least one.
        outputs: outputs of each network.
        layer_norm: whether hidden layers are normalised before the ReLU.
    """

    count: int
    inputs: int
    hidden: tuple[int, ...]
    outputs: int
    layer_norm: bool


def stack_shapes(shape: StackShape) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Name and shape of every parameter of a stack, in flat-buffer order."""
    count, width = shape.count, shape.inputs
    for number, out in enumerate(shape.hidden):
        yield f"{number}.weight", (count, width, out)
        yield f"{number}.bias", (count, 1, out)
        if shape.layer_norm:
            yield f"{number}.gain", (count, out)
            yield f"{number}.shift", (count, out)
        width = out
    yield "head.weight", (count, shape.outputs, width)
    yield "head.bias", (count, shape.outputs, 1)


def actor_shape(inputs: int, actions: int, hidden: tuple[int, ...]) -> StackShape:
    """The actor: outputs the means, then the log standard deviations, of ``actions`` numbers."""
    return StackShape(1, inputs, hidden, 2 * actions, layer_norm=False)


def critics_shape(inputs: int, actions: int, hidden: tuple[int, ...], *, layer_norm: bool) -> StackShape:
    """The twin critics Q_i(s, a)."""
    return StackShape(2, inputs + actions, hidden, 1, layer_norm=layer_norm)


def parameter_shapes(config: TaskConfig, inputs: int, actions: int) -> Shapes:
    """See ``protocol.AgentShapes``."""
    hidden = config.learner.hidden
    actor = actor_shape(inputs, actions, hidden)
    critics = critics_shape(inputs, actions, hidden, layer_norm=config.agents["sac"].layer_norm)
    parts = {"actor": actor, "average": actor, "critics": critics, "targets": critics}
    shapes = {f"{part}.{name}": size for part, shape in parts.items() for name, size in stack_shapes(shape)}
    return shapes | {"log_alpha": (1,), "average.low": (actions,), "average.high": (actions,)}


def size_parameters(hidden: Sequence[int]) -> tuple[str, str]:
    """See ``protocol.AgentShapes``."""
    return "actor.0.weight", "average.low"
