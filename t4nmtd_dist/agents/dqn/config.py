"""Settings of DQN."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from t4nmtd_dist.agents.common.off_policy_config import check_replay
from t4nmtd_dist.core.config import LearnerConfig
from t4nmtd_dist.core.setting_types import Count, CountOrZero, Positive, PositiveShare, Share


@dataclass(frozen=True)
class DQNConfig:
    """Double DQN (van Hasselt et al., 2016) with uniform replay, n-step returns and Polyak-averaged targets.

    Attributes:
        num_envs: environments per learner, stepped together.
        replay_rows: replay capacity in transitions.
        learning_starts: transitions before the first update.
        batch: transitions per update.
        updates_per_step: updates per interaction.
        n_step: maximum length of a return; cut at every DFA change.
        relabel_share: share of a batch read in a random DFA state with a transition of the sub-task (exact
            relabelling).
        peer_share: share of a batch from peers' replay, read as the sub-task's own (docs/decisions/016).
        success_share: share of a batch from the last steps before successes.
        learning_rate: of Adam.
        tau: Polyak step of the target network.
        max_grad_norm: gradient clipping threshold.
        epsilon_start: initial epsilon.
        epsilon_end: epsilon after ``epsilon_steps``.
        epsilon_steps: the learner's interactions over which epsilon decreases linearly.
    """

    num_envs: Count = 8
    replay_rows: Count = 300_000
    learning_starts: CountOrZero = 1000
    batch: Count = 256
    updates_per_step: Positive = 0.125
    n_step: Count = 3
    relabel_share: Share = 0.5
    peer_share: Share = 0.5
    success_share: Share = 0.25
    learning_rate: Positive = 3e-4
    tau: PositiveShare = 0.005
    max_grad_norm: Positive = 10.0
    epsilon_start: Share = 1.0
    epsilon_end: Share = 0.05
    epsilon_steps: Count = 10_000


CONFIG = DQNConfig
FORMER_KEYS: Mapping[str, str] = {"steps_per_iteration": "it is fixed at 10 now"}
ACTIONS = "discrete"
OFF_POLICY = True
EXPLORATION = ("dqn.epsilon_steps",)


def check(config: DQNConfig, learner: LearnerConfig) -> None:
    """Check that the replay buffer can hold ``learning_starts`` transitions.

    Raises:
        ConfigError: if not.
    """
    check_replay("dqn", config)
