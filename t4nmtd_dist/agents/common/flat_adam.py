"""Adam over one flat tensor: one fused pass over parameters, gradient and moments, on any device that has one.

``torch.optim.Adam`` computes the same, but its import costs a second or more and each step walks Python objects.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from t4nmtd_dist.agents.weights import Weights

BETA1, BETA2 = 0.9, 0.999


class FlatAdam:
    """Adam (Kingma and Ba, 2015) with torch's default betas.

    Args:
        parameters: float32 [P], changed in place by ``step``.
        learning_rate: its step size.
        epsilon: added to the root of the second moment; by default torch's.
        sizes: lengths of the parts that are updated one by one; by default all at once. The last numbers of a part
            are rounded otherwise than those before, so equality with torch, bit for bit, wants torch's parts.

    Attributes:
        gradient: [P], to be filled before each ``step``.
        learning_rate: may be changed at any time.
        steps: how many were taken.
    """

    def __init__(
        self, parameters: Tensor, learning_rate: float, epsilon: float = 1e-8, sizes: Sequence[int] = ()
    ) -> None:
        self.gradient = torch.zeros_like(parameters)
        self.steps = 0
        self.learning_rate, self._epsilon = learning_rate, epsilon
        self._mean, self._square = torch.zeros_like(parameters), torch.zeros_like(parameters)
        flat = (parameters, self.gradient, self._mean, self._square)
        self._parts = [list(torch.split(each, list(sizes) or [len(parameters)])) for each in flat]
        self._count = torch.zeros((), device=parameters.device)  # the same number, where the device needs it

    @classmethod
    def of_module(cls, module: nn.Module, learning_rate: float, epsilon: float = 1e-8) -> FlatAdam:
        """Adam over all parameters of a module, which become views of one flat tensor, and their gradients too."""
        parameters = list(module.parameters())
        flat = torch.cat([parameter.detach().view(-1) for parameter in parameters])
        adam = cls(flat, learning_rate, epsilon, [parameter.numel() for parameter in parameters])
        for parameter, part, gradient in zip(parameters, *adam._parts[:2], strict=True):
            parameter.data, parameter.grad = part.view_as(parameter), gradient.view_as(parameter)
        return adam

    def step(self) -> None:
        """Move the parameters against ``gradient``, which the caller has filled."""
        self.steps += 1
        self._count.add_(1)
        parameters, gradients, means, squares = self._parts
        torch._fused_adam_(
            parameters,
            gradients,
            means,
            squares,
            [],
            [self._count] * len(parameters),
            lr=self.learning_rate,
            beta1=BETA1,
            beta2=BETA2,
            weight_decay=0.0,
            eps=self._epsilon,
            amsgrad=False,
            maximize=False,
        )

    def state_dict(self) -> Weights:
        """Copies of the moments [P] and the number of steps []."""
        return {
            "mean": self._mean.cpu().numpy().copy(),
            "square": self._square.cpu().numpy().copy(),
            "steps": np.array(self.steps, np.float32),
        }

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from a ``state``."""
        self._mean.copy_(torch.from_numpy(state["mean"]))
        self._square.copy_(torch.from_numpy(state["square"]))
        self.steps = int(state["steps"])
        self._count.fill_(self.steps)
