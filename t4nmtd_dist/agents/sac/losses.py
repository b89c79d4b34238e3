"""SAC's losses (Haarnoja et al., 2018) with policy intervention (T4NMTD, Algorithm 2, line 12).

``torch_update`` differentiates these reference losses, and tests compare the gradients of ``fast_cpu``. Q_i are the two
critics, Q'_i their targets, pi the actor, alpha the entropy coefficient; a is drawn from pi(.|s), a' from pi(.|s').
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class NextValues:
    """A critic's values of a batch's next states s'.

    Attributes:
        min_q: min_i Q'_i(s', a') [B].
        log_pi: log pi(a'|s') [B].
    """

    min_q: Tensor
    log_pi: Tensor


def critic_target(
    reward: Tensor, discount: Tensor, own: NextValues, peer: NextValues, answered: Tensor, alpha: Tensor
) -> Tensor:
    """Y = r + gamma^n (min_i Q'_i(s', a') - alpha log pi(a'|s')) [B].

    Across a boundary, a peer acts in s': min Q', a' and log pi are the peer's, or the own ones without an answer. alpha
    is always the own one.

    Args:
        reward: r, the scaled n-step return [B].
        discount: gamma^n, 0 at terminals [B].
        own: from the own target critics and actor.
        peer: from the peers; arbitrary without an answer.
        answered: where a peer answered, bool [B].
        alpha: entropy coefficient [1].
    """
    min_q = torch.where(answered, peer.min_q, own.min_q)
    log_pi = torch.where(answered, peer.log_pi, own.log_pi)
    return reward + discount * (min_q - alpha * log_pi)


def critic_loss(errors: Tensor) -> Tensor:
    """Sum over both critics of 1/2 E[(Q_i(s, a) - y)^2], from the errors [2, B]."""
    return 0.5 * errors.square().mean(1).sum()


def actor_loss(alpha: Tensor, log_pi: Tensor, min_q: Tensor) -> Tensor:
    """E[alpha log pi(a|s) - min_i Q_i(s, a)], from log pi and min_i Q_i [B]."""
    return (alpha * log_pi - min_q).mean()


def alpha_loss(log_alpha: Tensor, log_pi: Tensor, target_entropy: float) -> Tensor:
    """-log alpha (E[log pi(a|s)] + target entropy): alpha rises while the entropy is below its target."""
    return -(log_alpha * (log_pi + target_entropy)).mean()
