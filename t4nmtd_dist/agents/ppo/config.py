"""Settings of PPO."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from t4nmtd_dist.core.setting_types import Count, Positive, Share


@dataclass(frozen=True)
class PPOConfig:
    """PPO (Schulman et al., 2017); Stable-Baselines3's defaults where no reason speaks against them.

    Attributes:
        num_envs: copies of the environment stepped together by one learner.
        rollout: steps of each copy between updates.
        epochs: passes over the roll-out.
        minibatch: rows of one gradient step.
        entropy_coefficient: weight of the entropy bonus of a learner without success.
        entropy_coefficient_successful: weight once every attempt succeeds; linear in the recent success between.
        gae_lambda: lambda of generalised advantage estimation.
        advantage_floor: advantages are divided by their standard deviation, but by no less than this, so that the
            noise of a roll-out without reward is not blown up into a policy.
    """

    num_envs: Count = 16
    rollout: Count = 64
    epochs: Count = 6
    minibatch: Count = 256
    learning_rate: Positive = 1e-3
    clip: float = 0.2
    entropy_coefficient: float = 0.15
    entropy_coefficient_successful: float = 0.005
    value_coefficient: float = 0.5
    gae_lambda: Share = 0.95
    max_grad_norm: float = 0.5
    advantage_floor: float = 0.1


CONFIG = PPOConfig
ACTIONS = "discrete"
EXPLORATION = ("ppo.entropy_coefficient",)
FORMER_KEYS: Mapping[str, str] = {"worlds": "it is called 'ppo.num_envs' now"}
