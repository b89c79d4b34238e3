"""Adam over one flat tensor: a fused pass over parameters, gradient and moments.

Equals ``torch.optim.Adam``, whose import takes a second or more and whose steps iterate over Python objects.
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
        learning_rate: step size.
        epsilon: added to the root of the second moment; torch's default.
        sizes: lengths of parts to update separately; by default one. The kernel rounds a part's last numbers
            differently, so bitwise equality with torch needs torch's parts.

    Attributes:
        gradient: [P], filled by the caller before each ``step``.
        learning_rate: may be changed at any time.
        steps: number of steps taken.
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
        self._count = torch.zeros((), device=parameters.device)  # the step count on the device

    @classmethod
    def of_module(cls, module: nn.Module, learning_rate: float, epsilon: float = 1e-8) -> FlatAdam:
        """Adam over a module's parameters; these and their gradients become views of flat tensors."""
        parameters = list(module.parameters())
        flat = torch.cat([parameter.detach().view(-1) for parameter in parameters])
        adam = cls(flat, learning_rate, epsilon, [parameter.numel() for parameter in parameters])
        for parameter, part, gradient in zip(parameters, *adam._parts[:2], strict=True):
            parameter.data, parameter.grad = part.view_as(parameter), gradient.view_as(parameter)
        return adam

    def step(self) -> None:
        """Apply ``gradient``, which the caller has filled, to the parameters."""
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
        """Restore from ``state_dict``."""
        self._mean.copy_(torch.from_numpy(state["mean"]))
        self._square.copy_(torch.from_numpy(state["square"]))
        self.steps = int(state["steps"])
        self._count.fill_(self.steps)
