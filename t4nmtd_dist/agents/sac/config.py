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
    """SAC (Haarnoja et al., 2018); Stable-Baselines3's defaults where no reason speaks against them.

    Attributes:
        num_envs: copies of the environment stepped together by one learner.
        replay_rows: experiences kept.
        learning_starts: experiences before the first update.
        batch: rows of one update.
        updates_per_step: updates per interaction.
        n_step: longest return, cut at every change of the DFA state.
        relabel_share: share of a batch that is read in a DFA state drawn from all those in which the sub-task has a
            transition, often the row's own among them (exact relabelling).
        peer_share: share of a batch from the experience of peers, read as the sub-task's own (docs/decisions/016).
        success_share: share of a batch from the last steps before past successes.
        exploration: ``held`` lets random actions interrupt the policy, each for some steps; ``sinusoid`` drives whole
            attempts by sinusoids; ``held+sinusoid`` does both, ``none`` neither (docs/decisions/014).
        exploration_share: share of the attempts of a learner without success in which each of the chosen kinds acts;
            it falls to 0 with the square of the share of attempts that fail.
        learning_rate_decay: share of the learning rate that is gone once every attempt succeeds; it goes with the
            square of the share of attempts that do.
        initial_alpha: entropy coefficient at the start, tuned from there; 0 for the one with which acting at random
            for ever is worth as much as one target.
        alpha_floor: share of ``initial_alpha`` below which that of a learner without success does not fall; it goes
            to 0 with the square of the share of attempts that fail.
        layer_norm: normalise the critics' hidden layers.
        actor_average: share of the actor that enters, at each of its updates, the running average of its weights
            that is evaluated and exported; 1 for the actor as it is (docs/decisions/015).
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
    """Check that the replay can hold what learning waits for.

    Raises:
        ConfigError: if not.
    """
    check_replay("sac", config)
