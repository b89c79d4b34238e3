"""Adam over one flat tensor: one fused pass over parameters, gradient and moments.

``torch.optim.Adam`` computes the same, but its import costs a second or more and each step walks Python objects.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from t4nmtd_dist.learners.networks import Weights

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-8


class FlatAdam:
    """Adam (Kingma and Ba, 2015) with torch's default betas and epsilon.

    Args:
        parameters: float32 [P], changed in place by ``step``.
        learning_rate: its step size.
    """

    def __init__(self, parameters: Tensor, learning_rate: float) -> None:
        self.gradient = torch.zeros_like(parameters)
        self._parameters, self._learning_rate = parameters, learning_rate
        self._mean, self._square = torch.zeros_like(parameters), torch.zeros_like(parameters)
        self._steps = torch.zeros(())
        self._count = self._steps.numpy()  # the same memory: counting in numpy costs less

    @property
    def steps(self) -> int:
        """Steps taken."""
        return int(self._count)

    def step(self) -> None:
        """Move the parameters against ``gradient``, which the caller has filled."""
        self._count += 1
        torch._fused_adam_(
            [self._parameters],
            [self.gradient],
            [self._mean],
            [self._square],
            [],
            [self._steps],
            lr=self._learning_rate,
            beta1=BETA1,
            beta2=BETA2,
            weight_decay=0.0,
            eps=EPSILON,
            amsgrad=False,
            maximize=False,
        )

    def state(self) -> Weights:
        """Copies of the moments [P] and the number of steps []."""
        return {
            "mean": self._mean.numpy().copy(),
            "square": self._square.numpy().copy(),
            "steps": self._steps.numpy().copy(),
        }

    def load_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from a ``state``."""
        self._mean.copy_(torch.from_numpy(state["mean"]))
        self._square.copy_(torch.from_numpy(state["square"]))
        self._steps.copy_(torch.from_numpy(state["steps"]))
