"""SAC's policy: a Gaussian squashed by tanh, its log-probability, and the gradient of the actor's loss through both.

All tensors are transposed, [.., rows], as ``sac_networks`` puts them out. Source: Haarnoja et al., 2018, appendix C;
bounds and the 1e-6 in the logarithm are those of Stable-Baselines3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
SQUASH_EPSILON = 1e-6
_HALF_LOG_2_PI = 0.5 * math.log(2 * math.pi)


@dataclass(frozen=True)
class SquashedSample:
    """Actions drawn by reparametrisation.

    Attributes:
        actions: tanh(mean + std * noise) [A, rows].
        log_probs: log pi of them [rows].
        scaled_noise: std * noise, the derivative of the unsquashed action by the log of std [A, rows].
        slope: 1 - actions**2, the derivative of tanh [A, rows].
        free: where log std is within its bounds, so that it has a gradient [A, rows].
    """

    actions: Tensor
    log_probs: Tensor
    scaled_noise: Tensor
    slope: Tensor
    free: Tensor

    def first(self, rows: int) -> SquashedSample:
        """Views of the first rows."""
        return SquashedSample(
            self.actions[:, :rows],
            self.log_probs[:rows],
            self.scaled_noise[:, :rows],
            self.slope[:, :rows],
            self.free[:, :rows],
        )


def squashed_sample(outputs: Tensor, noise: Tensor) -> SquashedSample:
    """Draw actions.

    Args:
        outputs: the actor's outputs, means above log standard deviations [2 A, rows].
        noise: standard normal [A, rows].
    """
    size = len(noise)
    mean, raw = outputs[:size], outputs[size:]
    log_std = raw.clamp(LOG_STD_MIN, LOG_STD_MAX)
    scaled_noise = log_std.exp().mul_(noise)
    actions = torch.add(mean, scaled_noise).tanh_()
    slope = torch.addcmul(torch.ones(()), actions, actions, value=-1.0)
    log_probs = (slope + SQUASH_EPSILON).log_().add_(log_std).addcmul_(noise, noise, value=0.5).add_(_HALF_LOG_2_PI)
    return SquashedSample(actions, log_probs.sum(0).neg_(), scaled_noise, slope, log_std == raw)


def deterministic_actions(outputs: Tensor) -> Tensor:
    """The mode's actions tanh(mean) [A, rows] of the actor's outputs [2 A, rows]."""
    return outputs[: len(outputs) // 2].tanh()


def output_gradient(sample: SquashedSample, d_actions: Tensor, d_log_probs: Tensor) -> Tensor:
    """Derivative of a loss by the actor's outputs [2 A, rows].

    Args:
        sample: what was drawn from them.
        d_actions: derivative of the loss by the actions, log-probabilities held fixed [A, rows].
        d_log_probs: derivative by every row's log-probability [], the same for all.
    """
    squash = (2.0 * sample.actions).mul_(sample.slope).div_(sample.slope + SQUASH_EPSILON)
    d_mean = (d_actions * sample.slope).add_(squash.mul_(d_log_probs))
    d_log_std = (d_mean * sample.scaled_noise).sub_(d_log_probs).mul_(sample.free)
    return torch.cat((d_mean, d_log_std))
