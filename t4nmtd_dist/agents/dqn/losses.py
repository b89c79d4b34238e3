"""Double DQN's target (van Hasselt et al., 2016) with policy intervention (T4NMTD, Algorithm 2, line 12), and its loss.

Q is the network that acts and learns, Q' its target network.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def double_q_target(
    reward: Tensor, discount: Tensor, next_q: Tensor, next_target_q: Tensor, peer_value: Tensor, answered: Tensor
) -> Tensor:
    """Y = r + gamma^n Q'(s', argmax_a Q(s', a)) [B].

    Across a boundary, a peer acts in s', so the bootstrap value is the peer's max_a Q'(s', a), or the own value without
    an answer.

    Args:
        reward: r, the scaled n-step return [B].
        discount: gamma^n, 0 at terminals [B].
        next_q: Q(s', .) [B, actions].
        next_target_q: Q'(s', .) [B, actions].
        peer_value: arbitrary without an answer [B].
        answered: where a peer answered, bool [B].
    """
    best = next_q.argmax(1, keepdim=True)
    own_value = next_target_q.gather(1, best).squeeze(1)
    return reward + discount * torch.where(answered, peer_value, own_value)


def q_loss(q: Tensor, actions: Tensor, target: Tensor) -> Tensor:
    """Mean Huber loss (threshold 1) of Q(s, a) - Y.

    Args:
        q: Q(s, .) [B, actions].
        actions: action indices, int64 [B, 1].
        target: Y [B].
    """
    return functional.smooth_l1_loss(q.gather(1, actions).squeeze(1), target)
