"""Settings of DQN."""

from __future__ import annotations

from dataclasses import dataclass

from t4nmtd_dist.agents.common.off_policy_config import check_replay
from t4nmtd_dist.core.config import LearnerConfig
from t4nmtd_dist.core.setting_types import Count, CountOrZero, Positive, PositiveShare, Share


@dataclass(frozen=True)
class DQNConfig:
    """Double DQN (van Hasselt et al., 2016) with uniform replay, n-step returns and Polyak-averaged targets.

    Attributes:
        num_envs: copies of the environment stepped together by one learner.
        steps_per_iteration: steps of each copy between two messages to the coordinator.
        replay_rows: experiences kept.
        learning_starts: experiences before the first update.
        batch: rows of one update.
        updates_per_step: updates per interaction.
        n_step: longest return, cut at every change of the DFA state.
        relabel_share: share of a batch that is read in a DFA state drawn from all those in which the sub-task has a
            transition (exact relabelling).
        peer_share: share of a batch from the experience of peers, read as the sub-task's own (docs/decisions/016).
        success_share: share of a batch from the last steps before past successes.
        learning_rate: of Adam.
        tau: step of the target network.
        max_grad_norm: longest gradient; a longer one is scaled down.
        epsilon_start: share of random actions at the start.
        epsilon_end: share of random actions once ``epsilon_steps`` are over.
        epsilon_steps: interactions of the learner itself over which epsilon falls, linearly.
    """

    num_envs: Count = 8
    steps_per_iteration: Count = 10
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
ACTIONS = "discrete"
EXPLORATION = ("dqn.epsilon_steps",)


def check(config: DQNConfig, learner: LearnerConfig) -> None:
    """Check that the replay can hold what learning waits for.

    Raises:
        ConfigError: if not.
    """
    check_replay("dqn", config)
