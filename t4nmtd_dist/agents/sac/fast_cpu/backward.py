"""Hand-written gradients of a stack, from the activations of ``forward.evaluate``.

Computes only what SAC needs: weight gradients, or, in the actor's step, the critics' action gradients. Tests compare
each with autograd.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from t4nmtd_dist.agents.sac.fast_cpu.forward import Activations, LayerActivations
from t4nmtd_dist.agents.sac.fast_cpu.matmul import multiply
from t4nmtd_dist.agents.sac.networks import HiddenLayer, Layers

Groups = list[tuple[int, slice]]

_relu_backward = torch.ops.aten.threshold_backward.grad_input
_layer_norm_backward = torch.ops.aten.native_layer_norm_backward


def weight_gradients(
    layers: Layers, gradients: Layers, inputs: Tensor, workspace: Activations, d_outputs: Tensor
) -> None:
    """Write the gradients of all parameters of a stack.

    Args:
        layers: its parameters.
        gradients: views of the flat gradient, overwritten.
        inputs: [rows, inputs].
        workspace: activations of their evaluation; ``delta`` is overwritten.
        d_outputs: derivative of the loss w.r.t. the outputs [n, outputs, rows].
    """
    top = workspace.layers[-1]
    multiply(d_outputs, top.hidden, gradients.head_weight)
    torch.sum(d_outputs, 2, keepdim=True, out=gradients.head_bias)
    _through_head(layers.head_weight, d_outputs, top.delta)
    for number in reversed(range(len(layers.hidden))):
        activations, gradient = workspace.layers[number], gradients.hidden[number]
        below = workspace.layers[number - 1].hidden if number else inputs.expand(len(d_outputs), *inputs.shape)
        _through_activation(layers.hidden[number], gradient, activations)
        multiply(below.transpose(1, 2), activations.delta, gradient.weight)
        torch.sum(activations.delta, 1, keepdim=True, out=gradient.bias)
        if number:
            weight = layers.hidden[number].weight
            multiply(activations.delta, weight.transpose(1, 2), workspace.layers[number - 1].delta)


def _through_head(weight: Tensor, d_outputs: Tensor, delta: Tensor) -> None:
    if weight.shape[1] == 1:  # an outer product: seven times faster than a matrix product
        torch.mul(d_outputs.transpose(1, 2), weight, out=delta)
    else:
        multiply(d_outputs.transpose(1, 2), weight, delta)


def _through_activation(layer: HiddenLayer, gradient: HiddenLayer, activations: LayerActivations) -> None:
    """Backpropagate ``delta`` through ReLU and layer norm, in place."""
    _relu_backward(activations.delta, activations.hidden, 0.0, grad_input=activations.delta)
    if layer.gain is None or layer.shift is None or gradient.gain is None or gradient.shift is None:
        return
    for n, (mean, scale) in enumerate(activations.statistics):
        delta, linear = activations.delta[n], activations.linear[n]
        d_linear, gradient.gain[n], gradient.shift[n] = _layer_norm_backward(
            delta, linear, (linear.shape[1],), mean, scale, layer.gain[n], layer.shift[n], (True, True, True)
        )
        delta.copy_(d_linear)


def chosen_input_gradient(
    layers: Layers, workspace: Activations, choice: NDArray[np.integer[Any]], first_input: int
) -> NDArray[np.floating[Any]]:
    """Derivative of each row's *chosen* network's output with respect to its last inputs.

    Rows are sorted by network, so each passes through one network only: half the work with two critics.

    Args:
        layers: parameters of a stack with one output.
        workspace: activations of its evaluation; ``delta`` is overwritten.
        choice: the network of each row [rows].
        first_input: first input to differentiate by.

    Returns:
        [inputs - first_input, rows], transposed like the outputs.
    """
    order, groups = _grouped(choice, len(layers.head_bias))
    picked = torch.from_numpy(choice[order] * workspace.rows + order)
    delta = workspace.layers[-1].delta.view(-1, layers.head_weight.shape[2])[: workspace.rows]
    for n, group in groups:
        delta[group] = layers.head_weight[n]
    for number in reversed(range(len(layers.hidden))):
        layer = layers.hidden[number]
        _through_chosen_activation(layer, workspace.layers[number], delta, picked, groups)
        if number:
            lower = workspace.layers[number - 1].delta.view(-1, layer.weight.shape[1])[: workspace.rows]
            for n, group in groups:
                multiply(delta[group], layer.weight[n].t(), lower[group])
            delta = lower
    return _input_gradient(layers.hidden[0].weight[:, first_input:], delta, order, groups)


def _grouped(choice: NDArray[np.integer[Any]], count: int) -> tuple[NDArray[np.int64], Groups]:
    """An order that sorts rows by network, and each network's slice of it."""
    order = np.argsort(choice, kind="stable")
    ends = np.bincount(choice, minlength=count).cumsum().tolist()
    spans = zip(range(count), [0, *ends[:-1]], ends, strict=True)
    return order, [(n, slice(begin, end)) for n, begin, end in spans if begin < end]


def _input_gradient(
    weight: Tensor, delta: Tensor, order: NDArray[np.int64], groups: Groups
) -> NDArray[np.floating[Any]]:
    sorted_rows = torch.empty(weight.shape[1], len(delta), dtype=delta.dtype)
    for n, group in groups:
        multiply(weight[n], delta[group].t(), sorted_rows[:, group])
    gradient = np.empty(sorted_rows.shape, sorted_rows.numpy().dtype)
    gradient[:, order] = sorted_rows.numpy()
    return gradient


def _through_chosen_activation(
    layer: HiddenLayer, activations: LayerActivations, delta: Tensor, picked: Tensor, groups: Groups
) -> None:
    width = delta.shape[1]
    hidden = activations.hidden.view(-1, width).index_select(0, picked)
    _relu_backward(delta, hidden, 0.0, grad_input=delta)
    if layer.gain is None:
        return
    linear = torch.index_select(activations.linear.view(-1, width), 0, picked, out=hidden)
    mean = torch.cat([mean for mean, _ in activations.statistics]).index_select(0, picked)
    scale = torch.cat([scale for _, scale in activations.statistics]).index_select(0, picked)
    for n, group in groups:
        delta[group] = _layer_norm_backward(
            delta[group], linear[group], (width,), mean[group], scale[group], layer.gain[n], None, (True, False, False)
        )[0]
