"""Evaluates a stack of networks without autograd, with one product per layer.

Activations go to preallocated buffers, which ``backward`` reads (docs/decisions/012). Hidden activations are [n, rows,
width]; outputs are *transposed*, [n, outputs, rows], because a product with few result columns is five times slower
than one with few rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from t4nmtd_dist.agents.sac.fast_cpu.matmul import multiply_add
from t4nmtd_dist.agents.sac.networks import LAYER_NORM_EPSILON, Layers
from t4nmtd_dist.agents.sac.shapes import StackShape


@dataclass
class LayerActivations:
    """Activations of a hidden layer: ``linear`` before the layer norm, ``hidden`` after the ReLU.

    Without layer norm both are one tensor. ``statistics`` are mean and 1 / standard deviation per network; ``delta`` is
    the buffer for the loss gradient.
    """

    linear: Tensor
    hidden: Tensor
    delta: Tensor
    statistics: list[tuple[Tensor, Tensor]]


class Activations:
    """Buffers for one evaluation of a stack.

    Args:
        rows: number of inputs.
        dtype: of the stack.
    """

    def __init__(self, shape: StackShape, rows: int, *, dtype: torch.dtype = torch.float32) -> None:
        self.rows = rows
        self.layers = [_layer_activations(shape, rows, width, dtype) for width in shape.hidden]
        self.outputs = torch.empty(shape.count, shape.outputs, rows, dtype=dtype)

    def first(self, rows: int) -> Activations:
        """Views of the first rows, for stacks of one network, where they are contiguous."""
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
    """Reusable buffers for evaluations of any number of rows."""

    def __init__(self, shape: StackShape) -> None:
        self._shape, self._largest = shape, Activations(shape, 1)

    def of(self, rows: int) -> Activations:
        """Buffers for ``rows`` rows; invalidates those returned before."""
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
    """The start of a buffer as a contiguous tensor with fewer rows."""
    size = [rows if number == axis else length for number, length in enumerate(buffer.shape)]
    return buffer.view(-1)[: math.prod(size)].view(size)


def evaluate(layers: Layers, inputs: Tensor, workspace: Activations) -> Tensor:
    """Outputs [n, outputs, rows] of a stack on inputs [rows, inputs], stored in ``workspace``."""
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
