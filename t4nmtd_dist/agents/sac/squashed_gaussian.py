"""SAC's tanh-squashed Gaussian policy in torch (Haarnoja et al., 2018, appendix C).

The bounds of log std and the 1e-6 in the logarithm are Stable-Baselines3's.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
SQUASH_EPSILON = 1e-6


def squashed(outputs: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Actions a = tanh(mean + std * noise) [rows, A] and log pi(a|s) [rows].

    Args:
        outputs: the actor's outputs, means then log standard deviations [rows, 2 A].
        noise: standard normal [rows, A].
    """
    mean, log_std = outputs.chunk(2, -1)
    log_std = log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)
    actions = torch.tanh(mean + log_std.exp() * noise)
    log_normal = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
    return actions, (log_normal - torch.log(1 - actions.square() + SQUASH_EPSILON)).sum(-1)
