"""Settings shared by all off-policy agents."""

from __future__ import annotations

from typing import Protocol

from t4nmtd_dist.core.errors import ConfigError


class OffPolicyConfig(Protocol):
    """The settings that ``OffPolicyLearner`` reads from an agent's ``CONFIG``; ``SACConfig`` describes them."""

    @property
    def num_envs(self) -> int:
        """Environments per learner, stepped together."""

    @property
    def replay_rows(self) -> int:
        """Replay capacity in transitions."""

    @property
    def learning_starts(self) -> int:
        """Transitions before the first update."""

    @property
    def batch(self) -> int:
        """Transitions per update."""

    @property
    def updates_per_step(self) -> float:
        """Updates per interaction."""

    @property
    def n_step(self) -> int:
        """Maximum number of steps in a return; cut at every DFA change."""

    @property
    def relabel_share(self) -> float:
        """Share of a batch read in any DFA state of the sub-task."""

    @property
    def peer_share(self) -> float:
        """Share of a batch from peers' replay."""

    @property
    def success_share(self) -> float:
        """Share of a batch from the last steps before past successes."""


def check_replay(section: str, config: OffPolicyConfig) -> None:
    """Check that the replay buffer can hold ``learning_starts`` transitions; ``section`` is for the message.

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
