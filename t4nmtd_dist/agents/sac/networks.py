"""Stacks of small MLPs in one flat buffer.

A *stack* is n networks of one shape: SAC's actor (n = 1) or critics (n = 2). Layers are views of one flat tensor, so
that Adam and the target update are one pass over memory. A hidden layer is linear, optional layer norm, ReLU.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from t4nmtd_dist.agents.sac.shapes import StackShape, stack_shapes
from t4nmtd_dist.agents.weights import Weights
from t4nmtd_dist.core.errors import PolicyError

LAYER_NORM_EPSILON = 1e-5
ALIGNMENT = 16  # floats per cache line; every parameter begins at one


@dataclass(frozen=True)
class HiddenLayer:
    """Views: weight [n, in, out], bias [n, 1, out], and layer norm's gain and shift [n, out]."""

    weight: Tensor
    bias: Tensor
    gain: Tensor | None
    shift: Tensor | None


@dataclass(frozen=True)
class Layers:
    """A stack's parameters or gradients, as views of a flat buffer."""

    hidden: tuple[HiddenLayer, ...]
    head_weight: Tensor  # [n, outputs, width]
    head_bias: Tensor  # [n, outputs, 1]
    named: dict[str, Tensor]


def _padded(size: tuple[int, ...]) -> int:
    return -(-math.prod(size) // ALIGNMENT) * ALIGNMENT


def flat_length(shape: StackShape) -> int:
    """Length of a stack's flat buffer, alignment gaps included."""
    return sum(_padded(size) for _, size in stack_shapes(shape))


def layers_of(flat: Tensor, shape: StackShape) -> Layers:
    """A stack's layers as views of its flat buffer [flat_length]."""
    named, begin = {}, 0
    for name, size in stack_shapes(shape):
        named[name] = flat[begin : begin + math.prod(size)].view(size)
        begin += _padded(size)
    hidden = tuple(
        HiddenLayer(named[f"{i}.weight"], named[f"{i}.bias"], named.get(f"{i}.gain"), named.get(f"{i}.shift"))
        for i in range(len(shape.hidden))
    )
    return Layers(hidden, named["head.weight"], named["head.bias"], named)


def _initialise(layers: Layers, generator: torch.Generator) -> None:
    for layer in layers.hidden:
        bound = layer.weight.shape[1] ** -0.5
        layer.weight.uniform_(-bound, bound, generator=generator)
        layer.bias.uniform_(-bound, bound, generator=generator)
        if layer.gain is not None:
            layer.gain.fill_(1.0)
    bound = layers.head_weight.shape[2] ** -0.5
    layers.head_weight.uniform_(-bound, bound, generator=generator)
    layers.head_bias.uniform_(-bound, bound, generator=generator)


class Stack:
    """n networks of one shape.

    Args:
        generator: draws initial parameters uniformly within 1 / sqrt(layer inputs), as ``torch.nn.Linear`` does; None
            initialises them to zero.
        dtype: float32; float64 in gradient tests.
        device: of the parameters, which are drawn on the CPU.
    """

    def __init__(
        self,
        shape: StackShape,
        generator: torch.Generator | None = None,
        *,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        self.shape = shape
        drawn = torch.zeros(flat_length(shape), dtype=dtype)
        if generator is not None:
            _initialise(layers_of(drawn, shape), generator)
        self.flat = drawn.to(device)
        self.layers = layers_of(self.flat, shape)

    def weights(self) -> Weights:
        """Copies of all parameters by name; the first axis is the network."""
        here = layers_of(self.flat.cpu(), self.shape)
        return {name: tensor.numpy().copy() for name, tensor in here.named.items()}

    def load(self, weights: Mapping[str, NDArray[Any]]) -> None:
        """Load arrays from ``weights``.

        Raises:
            PolicyError: if names or shapes differ.
        """
        named = self.layers.named
        expected = {name: tuple(tensor.shape) for name, tensor in named.items()}
        found = {name: tuple(array.shape) for name, array in weights.items()}
        if expected != found:
            wrong = sorted(expected.items() ^ found.items())[0][0]
            raise PolicyError(
                f"weights do not fit the network: {wrong} has shape {found.get(wrong)}, expected {expected.get(wrong)}"
            )
        for name, array in weights.items():
            named[name].copy_(torch.from_numpy(np.require(array, requirements="W")))  # torch warns of read-only arrays


def weights_of_stacks(stacks: Mapping[str, Stack]) -> Weights:
    """Copies of several stacks' parameters, named ``part.name``."""
    return {f"{part}.{name}": array for part, stack in stacks.items() for name, array in stack.weights().items()}


def evaluate_plainly(layers: Layers, inputs: Tensor) -> Tensor:
    """Outputs [n, rows, outputs] of a stack's networks on shared inputs [rows, inputs], for autograd."""
    hidden = inputs.expand(len(layers.head_bias), *inputs.shape)
    for layer in layers.hidden:
        hidden = _normalised(layer, torch.baddbmm(layer.bias, hidden, layer.weight)).relu()
    return torch.baddbmm(layers.head_bias.transpose(1, 2), hidden, layers.head_weight.transpose(1, 2))


def _normalised(layer: HiddenLayer, linear: Tensor) -> Tensor:
    if layer.gain is None or layer.shift is None:
        return linear
    normal = functional.layer_norm(linear, linear.shape[-1:], eps=LAYER_NORM_EPSILON)
    return normal * layer.gain[:, None] + layer.shift[:, None]
