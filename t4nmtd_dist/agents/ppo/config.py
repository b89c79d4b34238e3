"""Settings of PPO."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from t4nmtd_dist.core.setting_types import Count, NotNegative, Positive


@dataclass(frozen=True)
class PPOConfig:
    """PPO (Schulman et al., 2017); Stable-Baselines3's defaults where no reason speaks against them.

    Attributes:
        num_envs: copies of the environment stepped together by one learner.
        rollout: steps of each copy between updates.
        epochs: passes over the roll-out.
        minibatch: rows of one gradient step.
        entropy_coefficient: weight of the entropy bonus of a learner without success; it falls to 0.005, if it is not
            below that, as attempts succeed.
        advantage_floor: advantages are divided by their standard deviation, but by no less than this, so that the
            noise of a trajectory without reward is not blown up into a policy.
    """

    num_envs: Count = 16
    rollout: Count = 64
    epochs: Count = 6
    minibatch: Count = 256
    learning_rate: Positive = 1e-3
    entropy_coefficient: NotNegative = 0.15
    advantage_floor: Positive = 0.1


CONFIG = PPOConfig
ACTIONS = "discrete"
EXPLORATION = ("ppo.entropy_coefficient",)
FORMER_KEYS: Mapping[str, str] = {
    "worlds": "it is called 'ppo.num_envs' now",
    "clip": "it is fixed at 0.2 now",
    "entropy_coefficient_successful": "it is fixed at 0.005 now",
    "value_coefficient": "it is fixed at 0.5 now",
    "gae_lambda": "it is fixed at 0.95 now",
    "max_grad_norm": "it is fixed at 0.5 now",
}
