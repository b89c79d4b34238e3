"""Stacks of small multi-layer perceptrons in one flat buffer, evaluated together and without autograd.

SAC needs one actor and two critics. Both are a *stack* of n networks of one shape: n = 1 and n = 2. All parameters of
a stack lie in one flat tensor, so that Adam and the target update are one pass over memory; the layers are views of
it. Hidden layers are linear, layer norm where wanted, ReLU. Activations go to preallocated buffers, from which
``sac_backward`` computes gradients (docs/decisions/012 has what this buys).

Layout: hidden activations are [n, rows, width]; outputs are *transposed*, [n, outputs, rows], because a product whose
result has only a few columns is five times slower than the same product with few rows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from t4nmtd_dist.agents.sac.fast_cpu.matmul import multiply_add
from t4nmtd_dist.agents.weights import Weights
from t4nmtd_dist.core.errors import PolicyError

LAYER_NORM_EPSILON = 1e-5
ALIGNMENT = 16  # floats: every parameter begins at a cache line


@dataclass(frozen=True)
class StackShape:
    """Sizes of a stack.

    Attributes:
        count: n, the number of networks.
        inputs: numbers that all networks of the stack see.
        hidden: widths of the hidden layers, at least one.
        outputs: outputs of each network.
        layer_norm: whether hidden layers are normalised before the ReLU.
    """

    count: int
    inputs: int
    hidden: tuple[int, ...]
    outputs: int
    layer_norm: bool


@dataclass(frozen=True)
class HiddenLayer:
    """Views: weight [n, in, out], bias [n, 1, out], and gain and shift [n, out] of the layer norm."""

    weight: Tensor
    bias: Tensor
    gain: Tensor | None
    shift: Tensor | None


@dataclass(frozen=True)
class Layers:
    """Views of a flat buffer: the parameters of a stack, or their gradients."""

    hidden: tuple[HiddenLayer, ...]
    head_weight: Tensor  # [n, outputs, width]
    head_bias: Tensor  # [n, outputs, 1]
    named: dict[str, Tensor]


def parameter_shapes(shape: StackShape) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Name and shape of every parameter of a stack, in their order in the flat buffer."""
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


def _padded(size: tuple[int, ...]) -> int:
    return -(-math.prod(size) // ALIGNMENT) * ALIGNMENT


def flat_length(shape: StackShape) -> int:
    """Length of the flat buffer of a stack, the gaps that align its layers included."""
    return sum(_padded(size) for _, size in parameter_shapes(shape))


def layers_of(flat: Tensor, shape: StackShape) -> Layers:
    """The layers of a stack as views of its flat buffer [flat_length]."""
    named, begin = {}, 0
    for name, size in parameter_shapes(shape):
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
        shape: their sizes.
        generator: draws initial weights and biases uniformly within 1 / sqrt(inputs of the layer), as
            ``torch.nn.Linear`` does; None leaves them at zero.
        dtype: float32; float64 in tests of gradients.
        device: where the parameters lie; they are drawn on the CPU.
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
        """Copies of all parameters by name, the first axis being the network."""
        here = layers_of(self.flat.cpu(), self.shape)
        return {name: tensor.numpy().copy() for name, tensor in here.named.items()}

    def load(self, weights: Mapping[str, NDArray[Any]]) -> None:
        """Put arrays from ``weights`` into the stack.

        Raises:
            PolicyError: if names or shapes differ from the stack's.
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
            named[name].copy_(torch.from_numpy(np.require(array, requirements="W")))  # torch warns of read-only ones


@dataclass
class LayerActivations:
    """What a hidden layer leaves behind: ``linear`` before the layer norm, ``hidden`` after the ReLU.

    Without layer norm both are one tensor. ``statistics`` are mean and 1 / standard deviation per network. ``delta``
    is room for the gradient of the loss.
    """

    linear: Tensor
    hidden: Tensor
    delta: Tensor
    statistics: list[tuple[Tensor, Tensor]]


class Activations:
    """Room for one evaluation of a stack on a number of rows.

    Args:
        shape: the stack's sizes.
        rows: how many inputs are evaluated at once.
        dtype: that of the stack.
    """

    def __init__(self, shape: StackShape, rows: int, *, dtype: torch.dtype = torch.float32) -> None:
        self.rows = rows
        self.layers = [_layer_activations(shape, rows, width, dtype) for width in shape.hidden]
        self.outputs = torch.empty(shape.count, shape.outputs, rows, dtype=dtype)

    def first(self, rows: int) -> Activations:
        """Views of the first rows; for stacks of one network, where they are contiguous."""
        if rows == self.rows:
            return self
        part = object.__new__(Activations)
        part.rows, part.outputs = rows, self.outputs[:, :, :rows]
        part.layers = [
            LayerActivations(
                layer.linear[:, :rows],
                layer.hidden[:, :rows],
                layer.delta[:, :rows],
                [(mean[:rows], scale[:rows]) for mean, scale in layer.statistics],
            )
            for layer in self.layers
        ]
        return part


def _layer_activations(shape: StackShape, rows: int, width: int, dtype: torch.dtype) -> LayerActivations:
    size = (shape.count, rows, width)
    hidden, delta = torch.empty(size, dtype=dtype), torch.empty(size, dtype=dtype)
    linear = torch.empty(size, dtype=dtype) if shape.layer_norm else hidden
    return LayerActivations(linear, hidden, delta, [])


class GrowingWorkspace:
    """Room for evaluations of any number of rows, one after the other: kept, and replaced by a larger one if needed.

    Args:
        shape: the stack's sizes.
    """

    def __init__(self, shape: StackShape) -> None:
        self._shape, self._largest = shape, Activations(shape, 1)

    def of(self, rows: int) -> Activations:
        """Room for ``rows`` rows; what the last one held is lost."""
        if rows > self._largest.rows:
            self._largest = Activations(self._shape, rows)
        return self._largest if rows == self._largest.rows else self._part(rows)

    def _part(self, rows: int) -> Activations:
        part = object.__new__(Activations)
        part.rows, part.outputs = rows, _repacked(self._largest.outputs, 2, rows)
        part.layers = []
        for layer in self._largest.layers:
            hidden, delta = _repacked(layer.hidden, 1, rows), _repacked(layer.delta, 1, rows)
            linear = hidden if layer.linear is layer.hidden else _repacked(layer.linear, 1, rows)
            part.layers.append(LayerActivations(linear, hidden, delta, []))
        return part


def _repacked(buffer: Tensor, axis: int, rows: int) -> Tensor:
    """The beginning of a buffer as a contiguous tensor with fewer rows."""
    size = [rows if number == axis else length for number, length in enumerate(buffer.shape)]
    return buffer.view(-1)[: math.prod(size)].view(size)


def evaluate(layers: Layers, inputs: Tensor, workspace: Activations) -> Tensor:
    """Outputs [n, outputs, rows] of all networks of a stack on inputs [rows, inputs]; they lie in ``workspace``."""
    below = inputs.expand(len(layers.head_bias), *inputs.shape)
    for layer, activations in zip(layers.hidden, workspace.layers, strict=True):
        multiply_add(layer.bias, below, layer.weight, activations.linear)
        if layer.gain is None or layer.shift is None:
            torch.relu_(activations.hidden)
        else:
            _normalise(layer.gain, layer.shift, activations)
        below = activations.hidden
    multiply_add(layers.head_bias, layers.head_weight, below.transpose(1, 2), workspace.outputs)
    return workspace.outputs


def _normalise(gain: Tensor, shift: Tensor, activations: LayerActivations) -> None:
    width = (gain.shape[1],)
    activations.statistics.clear()
    for n, linear in enumerate(activations.linear):
        normal, mean, scale = torch.native_layer_norm(linear, width, gain[n], shift[n], LAYER_NORM_EPSILON)
        torch.clamp_min(normal, 0.0, out=activations.hidden[n])
        activations.statistics.append((mean, scale))
