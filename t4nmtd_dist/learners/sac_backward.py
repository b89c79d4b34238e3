"""Hand-written gradients of a stack of networks, from the activations that ``sac_networks.evaluate`` left behind.

Only what SAC's update needs is computed: gradients of weights but none of the inputs, or, in the actor's step,
gradients of the actions but none of the critics' weights. Tests compare every one with autograd.
"""

from __future__ import annotations

import torch
from torch import Tensor

from t4nmtd_dist.learners.sac_networks import Activations, HiddenLayer, LayerActivations, Layers

_relu_backward = torch.ops.aten.threshold_backward.grad_input
_layer_norm_backward = torch.ops.aten.native_layer_norm_backward


def weight_gradients(layers: Layers, gradients: Layers, inputs: Tensor, room: Activations, d_outputs: Tensor) -> None:
    """Write the gradients of all parameters of a stack.

    Args:
        layers: its parameters.
        gradients: views of the flat gradient, overwritten.
        inputs: what was evaluated [rows, inputs].
        room: the activations of that evaluation; their ``delta`` is overwritten.
        d_outputs: derivative of the loss by the outputs [n, outputs, rows].
    """
    top = room.layers[-1]
    torch.bmm(d_outputs, top.hidden, out=gradients.head_weight)
    torch.sum(d_outputs, 2, keepdim=True, out=gradients.head_bias)
    torch.bmm(d_outputs.transpose(1, 2), layers.head_weight, out=top.delta)
    for number in reversed(range(len(layers.hidden))):
        activations, gradient = room.layers[number], gradients.hidden[number]
        below = room.layers[number - 1].hidden if number else inputs.expand(len(d_outputs), *inputs.shape)
        _through_activation(layers.hidden[number], gradient, activations)
        torch.bmm(below.transpose(1, 2), activations.delta, out=gradient.weight)
        torch.sum(activations.delta, 1, keepdim=True, out=gradient.bias)
        if number:
            weight = layers.hidden[number].weight
            torch.bmm(activations.delta, weight.transpose(1, 2), out=room.layers[number - 1].delta)


def _through_activation(layer: HiddenLayer, gradient: HiddenLayer, activations: LayerActivations) -> None:
    """Turn ``delta`` from the derivative by the ReLU's output into that by the linear part."""
    _relu_backward(activations.delta, activations.hidden, 0.0, grad_input=activations.delta)
    if layer.gain is None or layer.shift is None or gradient.gain is None or gradient.shift is None:
        return
    for n, (mean, scale) in enumerate(activations.statistics):
        delta, linear = activations.delta[n], activations.linear[n]
        d_linear, gradient.gain[n], gradient.shift[n] = _layer_norm_backward(
            delta, linear, (linear.shape[1],), mean, scale, layer.gain[n], layer.shift[n], (True, True, True)
        )
        delta.copy_(d_linear)


def chosen_input_gradient(layers: Layers, room: Activations, choice: Tensor, first_input: int) -> Tensor:
    """Derivative of every row's *chosen* network's only output by its last inputs.

    Rows are sorted by network, so that each goes back through one network alone: half of the work with two critics.

    Args:
        layers: parameters of a stack with one output.
        room: the activations of its evaluation; their ``delta`` is overwritten.
        choice: the network of each row, int64 [rows].
        first_input: derivatives are by the inputs from this one on.

    Returns:
        [inputs - first_input, rows], transposed as the outputs are.
    """
    count, rows = len(layers.head_bias), room.rows
    order = torch.argsort(choice)
    picked = choice[order].mul_(rows).add_(order)
    bounds = _bounds(choice, count)
    delta = room.layers[-1].delta.view(-1, layers.head_weight.shape[2])[:rows]
    for n, (begin, end) in enumerate(bounds):
        delta[begin:end] = layers.head_weight[n]
    for number in reversed(range(len(layers.hidden))):
        layer = layers.hidden[number]
        delta = _through_chosen_activation(layer, room.layers[number], delta, picked, bounds)
        if number:
            lower = room.layers[number - 1].delta.view(-1, layer.weight.shape[1])[:rows]
            for n, (begin, end) in enumerate(bounds):
                torch.mm(delta[begin:end], layer.weight[n].t(), out=lower[begin:end])
            delta = lower
    parts = [layers.hidden[0].weight[n, first_input:] @ delta[begin:end].t() for n, (begin, end) in enumerate(bounds)]
    sorted_rows = torch.cat(parts, 1)
    return torch.empty_like(sorted_rows).index_copy_(1, order, sorted_rows)


def _bounds(choice: Tensor, count: int) -> list[tuple[int, int]]:
    ends: list[int] = torch.bincount(choice, minlength=count).cumsum(0).tolist()
    return list(zip([0, *ends[:-1]], ends, strict=True))


def _through_chosen_activation(
    layer: HiddenLayer, activations: LayerActivations, delta: Tensor, picked: Tensor, bounds: list[tuple[int, int]]
) -> Tensor:
    width = delta.shape[1]
    hidden = activations.hidden.view(-1, width).index_select(0, picked)
    _relu_backward(delta, hidden, 0.0, grad_input=delta)
    if layer.gain is None:
        return delta
    linear = torch.index_select(activations.linear.view(-1, width), 0, picked, out=hidden)
    mean = torch.cat([mean for mean, _ in activations.statistics]).index_select(0, picked)
    scale = torch.cat([scale for _, scale in activations.statistics]).index_select(0, picked)
    for n, (begin, end) in enumerate(bounds):
        part = slice(begin, end)
        delta[part] = _layer_norm_backward(
            delta[part], linear[part], (width,), mean[part], scale[part], layer.gain[n], None, (True, False, False)
        )[0]
    return delta
