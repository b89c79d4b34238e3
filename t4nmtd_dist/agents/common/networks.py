"""Small torch networks over product states, and their weights as arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from t4nmtd_dist.agents.weights import Weights
from t4nmtd_dist.core.errors import PolicyError


def mlp(inputs: int, hidden: Sequence[int], outputs: int, *, last_gain: float) -> nn.Sequential:
    """A tanh MLP with orthogonal initialisation: gain sqrt(2), and ``last_gain`` in the last layer."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [_linear(inputs, width, 2**0.5), nn.Tanh()]
        inputs = width
    return nn.Sequential(*layers, _linear(inputs, outputs, last_gain))


def _linear(inputs: int, outputs: int, gain: float) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


def weights_of(module: nn.Module) -> Weights:
    """Copies of a module's parameters as numpy arrays by name."""
    return {name: tensor.detach().cpu().numpy().copy() for name, tensor in module.state_dict().items()}


def load_weights(module: nn.Module, weights: Mapping[str, NDArray[Any]]) -> None:
    """Load arrays from ``weights_of`` into a module.

    Raises:
        PolicyError: if names or shapes differ from the module's.
    """
    tensors = {name: torch.from_numpy(np.array(array)) for name, array in weights.items()}
    try:
        module.load_state_dict(tensors)
    except RuntimeError as error:
        raise PolicyError(f"weights do not fit the network: {error}") from None


def mlp_of(weights: Weights, hidden: Sequence[int]) -> nn.Sequential:
    """The ``mlp`` with these parameters; input and output sizes follow from their shapes.

    Raises:
        PolicyError: if there are none, or names or shapes differ from those of an ``mlp`` with layers ``hidden``.
    """
    names = (name for name in weights if name.endswith(".weight"))
    matrices = [weights[name] for name in sorted(names, key=lambda name: int(name.split(".")[0]))]
    if not matrices:
        raise PolicyError("an actor has no weights; the export is damaged or of another format")
    network = mlp(int(matrices[0].shape[1]), hidden, int(matrices[-1].shape[0]), last_gain=0.01)
    load_weights(network, weights)
    return network
