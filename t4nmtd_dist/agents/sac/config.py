"""Settings of SAC."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from t4nmtd_dist.agents.common.off_policy_config import check_replay
from t4nmtd_dist.core.config import LearnerConfig
from t4nmtd_dist.core.setting_types import Count, CountOrZero, NotNegative, Positive, PositiveShare, Share


@dataclass(frozen=True)
class SACConfig:
    """SAC (Haarnoja et al., 2018), based on Stable-Baselines3's defaults.

    Attributes:
        num_envs: environments per learner, stepped together.
        replay_rows: replay capacity in transitions.
        learning_starts: transitions before the first update.
        batch: transitions per update.
        updates_per_step: updates per interaction.
        n_step: maximum length of a return; cut at every DFA change.
        relabel_share: share of a batch read in a random DFA state with a transition of the sub-task, possibly the row's
            own (exact relabelling).
        peer_share: share of a batch from peers' replay, read as the sub-task's own (docs/decisions/016).
        success_share: share of a batch from the last steps before successes.
        exploration: ``held`` interrupts the policy with held random actions; ``sinusoid`` drives whole attempts by
            sinusoids; ``held+sinusoid`` does both, ``none`` neither (docs/decisions/014).
        exploration_share: share of attempts in which each chosen kind acts at success rate 0; falls with the squared
            failure rate.
        learning_rate: of the three optimisers.
        learning_rate_decay: share of the learning rate removed at success rate 1; grows with the squared success rate.
        initial_alpha: initial entropy coefficient; 0 selects the one at which acting at random forever is worth one
            target.
        alpha_floor: lower bound of the entropy coefficient at success rate 0, as a share of its initial value; falls
            with the squared failure rate.
        layer_norm: normalise the critics' hidden layers.
        actor_average: share of the actor added to its running average, which is evaluated and exported, at each actor
            update; 1 means no averaging (docs/decisions/015).
    """

    num_envs: Count = 4
    replay_rows: Count = 300_000
    learning_starts: CountOrZero = 1000
    batch: Count = 256
    updates_per_step: Positive = 0.5
    n_step: Count = 5
    relabel_share: Share = 0.5
    peer_share: Share = 0.5
    success_share: Share = 0.25
    exploration: Literal["held+sinusoid", "held", "sinusoid", "none"] = "held+sinusoid"
    exploration_share: Share = 0.25
    learning_rate: Positive = 3e-4
    learning_rate_decay: Share = 0.0
    initial_alpha: NotNegative = 0.0
    alpha_floor: Share = 1.0
    layer_norm: bool = True
    actor_average: PositiveShare = 0.005


CONFIG = SACConfig
ACTIONS = "continuous"
OFF_POLICY = True
EXPLORATION = ("sac.exploration_share",)
LEARNER_DEFAULTS: Mapping[str, Any] = {
    "gamma": 0.98,
    "shaping": "subtask",
    "error_penalty": 10.0,
    "reward_scale": 0.1,
    "hidden": [128, 128],
}
"""Measured in docs/decisions/014."""
FORMER_KEYS: Mapping[str, str] = {
    "worlds": "it is called 'sac.num_envs' now",
    "wave_share": 'use sac.exploration = "sinusoid" or "held+sinusoid" with \'sac.exploration_share\'',
    "steps_per_iteration": "it is fixed at 10 now",
    "tau": "it is fixed at 0.005 now",
    "hold_share": 'use sac.exploration = "held" or "held+sinusoid" with \'sac.exploration_share\'',
}


def check(config: SACConfig, learner: LearnerConfig) -> None:
    """Check that the replay buffer can hold ``learning_starts`` transitions.

    Raises:
        ConfigError: if not.
    """
    check_replay("sac", config)
