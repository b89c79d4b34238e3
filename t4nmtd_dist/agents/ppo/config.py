"""Settings of PPO."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from t4nmtd_dist.core.setting_types import Count, NotNegative, Positive


@dataclass(frozen=True)
class PPOConfig:
    """PPO (Schulman et al., 2017), based on Stable-Baselines3's defaults.

    Attributes:
        num_envs: environments per learner, stepped together.
        rollout: steps per environment between updates.
        epochs: passes over the rollout.
        minibatch: rows per gradient step.
        learning_rate: of Adam.
        entropy_coefficient: weight of the entropy bonus at success rate 0; falls to at most 0.005 at success rate 1.
        advantage_floor: lower bound of the standard deviation that advantages are divided by, so that the noise of a
            trajectory without reward is not amplified.
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
