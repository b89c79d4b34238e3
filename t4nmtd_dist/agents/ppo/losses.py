"""PPO's losses (Schulman et al., 2017), with policy intervention (T4NMTD, Algorithm 2, line 12)."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from t4nmtd_dist.agents.common.peer_values import PeerValues
from t4nmtd_dist.agents.ppo.trajectory import Trajectory

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]


def bootstrap_values(
    trajectory: Trajectory, values: Floats, last_values: Floats, boundary_values: Floats, answers: PeerValues
) -> Floats:
    """Bootstrap value of each step, float32 [T, N].

    Inside an attempt: V(s_{t+1}). At a cut: the peer's value of s' if the DFA moved to another sub-task's state and the
    peer answered, else the own critic's. In F, in E and at environment termination: 0.

    Args:
        trajectory: T steps of N environments.
        values: V(s_t) [T, N].
        last_values: V of the states after the last step [N].
        boundary_values: the own critic's values of s' at non-terminal cuts, in row order [k].
        answers: peers' values, by rows t * N + n.
    """
    next_values = np.concatenate([values[1:], last_values[None]])
    next_values[trajectory.boundary] = boundary_values
    next_values.reshape(-1)[answers.rows] = answers.values
    next_values[trajectory.terminal] = 0.0
    return next_values


def generalised_advantages(
    rewards: Floats, values: Floats, next_values: Floats, cut: Mask, *, gamma: float, gae_lambda: float
) -> Floats:
    """GAE (Schulman et al., 2016), float32 [T, N]: delta_t + gamma lambda A_{t+1}, up to the next cut.

    Args:
        rewards: scaled [T, N].
        values: V(s_t) [T, N].
        next_values: from ``bootstrap_values`` [T, N].
        cut: where the trace stops [T, N].
        gamma: discount.
        gae_lambda: lambda.
    """
    delta = rewards + gamma * next_values - values
    decay = gamma * gae_lambda * ~cut
    advantages = np.zeros_like(delta)
    carried = np.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        carried = delta[t] + decay[t] * carried
        advantages[t] = carried
    return advantages


def clipped_surrogate(log_probs: Tensor, old_log_probs: Tensor, advantages: Tensor, clip: float) -> Tensor:
    """-E[min(ratio A, clip(ratio, 1 - eps, 1 + eps) A)], ratio = pi(a|s) / pi_old(a|s); arguments [B]."""
    ratio = torch.exp(log_probs - old_log_probs)
    clipped = ratio.clamp(1 - clip, 1 + clip)
    return -torch.minimum(ratio * advantages, clipped * advantages).mean()


def entropy_of(log_probs: Tensor) -> Tensor:
    """Mean entropy in nats of categoricals, from log-probabilities [B, actions]."""
    return -(log_probs.exp() * log_probs).sum(-1).mean()


def value_loss(values: Tensor, returns: Tensor) -> Tensor:
    """E[(V(s) - R)^2] of values and returns [B]."""
    return (values - returns).square().mean()
