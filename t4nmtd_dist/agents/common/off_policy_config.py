"""Settings that every off-policy agent has, whatever its algorithm."""

from __future__ import annotations

from typing import Protocol


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
