"""Settings that every off-policy agent has, whatever its algorithm."""

from __future__ import annotations

from typing import Protocol

from t4nmtd_dist.core.errors import ConfigError


class OffPolicyConfig(Protocol):
    """What ``OffPolicyLearner`` reads of an agent's ``CONFIG``; ``SACConfig`` describes every setting."""

    @property
    def num_envs(self) -> int:
        """Copies of the environment stepped together by one learner."""

    @property
    def replay_rows(self) -> int:
        """Experiences kept."""

    @property
    def learning_starts(self) -> int:
        """Experiences before the first update."""

    @property
    def batch(self) -> int:
        """Rows of one update."""

    @property
    def updates_per_step(self) -> float:
        """Updates per interaction."""

    @property
    def n_step(self) -> int:
        """Longest return, cut at every change of the DFA state."""

    @property
    def relabel_share(self) -> float:
        """Share of a batch that is read in any DFA state of the sub-task."""

    @property
    def peer_share(self) -> float:
        """Share of a batch from the experience of peers."""

    @property
    def success_share(self) -> float:
        """Share of a batch from the last steps before past successes."""


def check_replay(section: str, config: OffPolicyConfig) -> None:
    """Check that the replay can hold what learning waits for.

    Args:
        section: of the settings, for the message; "sac".
        config: the settings.

    Raises:
        ConfigError: if it cannot.
    """
    kept = config.replay_rows // config.num_envs * config.num_envs
    if kept < max(config.num_envs, config.learning_starts):
        raise ConfigError(
            f"{section}.replay_rows = {config.replay_rows}: expected at least {section}.learning_starts = "
            f"{config.learning_starts}, in whole steps of {section}.num_envs = {config.num_envs} copies; otherwise "
            "learning never starts"
        )
