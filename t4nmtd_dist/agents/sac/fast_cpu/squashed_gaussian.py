"""``sac.squashed_gaussian`` by hand, with the gradient of the actor's loss through it.

All arrays are transposed, [.., rows], like ``forward``'s outputs. numpy, because its calls cost half of torch's on such
small arrays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.sac.squashed_gaussian import LOG_STD_MAX, LOG_STD_MIN, SQUASH_EPSILON
from t4nmtd_dist.agents.sac.updater import Reals

_HALF_LOG_2_PI = 0.5 * math.log(2 * math.pi)


@dataclass(frozen=True)
class SquashedSample:
    """Actions sampled by reparametrisation.

    Attributes:
        actions: tanh(mean + std * noise) [A, rows].
        log_probs: their log pi [rows].
        scaled_noise: std * noise, the derivative of the unsquashed action w.r.t. log std [A, rows].
        slope: 1 - actions**2, the derivative of tanh [A, rows].
        free: where log std is unclipped, so that it has a gradient [A, rows].
    """

    actions: Reals
    log_probs: Reals
    scaled_noise: Reals
    slope: Reals
    free: NDArray[np.bool_]

    def part(self, rows: slice) -> SquashedSample:
        """Views of some rows."""
        return SquashedSample(
            self.actions[:, rows],
            self.log_probs[rows],
            self.scaled_noise[:, rows],
            self.slope[:, rows],
            self.free[:, rows],
        )


def squashed_sample(outputs: Reals, noise: Reals) -> SquashedSample:
    """Sample actions.

    Args:
        outputs: the actor's outputs, means above log standard deviations [2 A, rows].
        noise: standard normal [A, rows].
    """
    size = len(noise)
    mean, raw = outputs[:size], outputs[size:]
    log_std = np.minimum(np.maximum(raw, LOG_STD_MIN), LOG_STD_MAX)
    scaled_noise = np.exp(log_std)
    scaled_noise *= noise
    actions = mean + scaled_noise
    np.tanh(actions, out=actions)
    slope = 1.0 - actions * actions
    surprise = np.log(slope + SQUASH_EPSILON)
    surprise += log_std
    surprise += 0.5 * noise * noise
    log_probs = -surprise.sum(0)
    log_probs -= size * _HALF_LOG_2_PI
    return SquashedSample(actions, log_probs, scaled_noise, slope, log_std == raw)


def deterministic_actions(outputs: Reals) -> Reals:
    """Mode actions tanh(mean) [A, rows] from the actor's outputs [2 A, rows]."""
    actions: Reals = np.tanh(outputs[: len(outputs) // 2])
    return actions


def output_gradient(sample: SquashedSample, d_actions: Reals, d_log_probs: float) -> Reals:
    """Derivative of a loss with respect to the actor's outputs [2 A, rows].

    Args:
        sample: sampled from these outputs.
        d_actions: derivative w.r.t. the actions at fixed log-probabilities [A, rows].
        d_log_probs: derivative w.r.t. every row's log-probability, the same for all.
    """
    size, rows = d_actions.shape
    gradient = np.empty((2 * size, rows), d_actions.dtype)
    d_mean, d_log_std = gradient[:size], gradient[size:]
    np.divide(sample.actions, sample.slope + SQUASH_EPSILON, out=d_mean)
    d_mean *= 2.0 * d_log_probs
    d_mean += d_actions
    d_mean *= sample.slope
    np.multiply(d_mean, sample.scaled_noise, out=d_log_std)
    d_log_std -= d_log_probs
    d_log_std *= sample.free
    return gradient
