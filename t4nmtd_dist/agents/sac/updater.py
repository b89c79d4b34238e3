"""Interface of SAC's gradient step and its two implementations.

``fast_cpu`` is the fast one for the CPU, with hand-written gradients; ``torch_update`` is plain torch, for any device.
They share weights and optimiser states, so policies, checkpoints and replicas work with both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.batches import Batch
from t4nmtd_dist.agents.weights import Weights

Floats = NDArray[np.float32]
Reals = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class SACSettings:
    """Settings of SAC's gradient step; the defaults are Stable-Baselines3's unless noted.

    Attributes:
        learning_rate: of the three optimisers.
        tau: Polyak step of the target critics.
        actor_average: share of the actor added to its running average at every actor step; the first steps weigh
            equally. 1 means no averaging.
        initial_alpha: initial entropy coefficient; 0.1, since 1 would dwarf a sparse reward.
        target_entropy: nats per action; None for minus the action size.
        actor_every: critic updates per update of actor and entropy coefficient; above 1 if critics need many updates
            per interaction (Chen et al., 2021: REDQ).
        layer_norm: normalise the critics' hidden layers.
        hidden: hidden layer widths of actor and critics.
    """

    learning_rate: float = 3e-4
    tau: float = 0.005
    actor_average: float = 1.0
    initial_alpha: float = 0.1
    target_entropy: float | None = None
    actor_every: int = 1
    layer_norm: bool = True
    hidden: tuple[int, ...] = (256, 256)


@dataclass(frozen=True)
class PeerSoftValues:
    """Peers' answers for some rows of a batch.

    Attributes:
        rows: row numbers in the batch [k].
        values: min_i Q'_i(s', a') of the peers' target critics, a' sampled from the peers' actors [k].
        log_probs: log pi(a'|s') of the peers' actors [k].
    """

    rows: NDArray[np.int64]
    values: Floats
    log_probs: Floats


class SoftActorCritic(Protocol):
    """Actor, twin critics, target critics, entropy coefficient, and their update."""

    settings: SACSettings

    def act(self, states: Floats, *, deterministic: bool) -> Floats:
        """Actions [N, A] within [-1, 1] for product states [N, d]: sampled, or the mode."""

    def soft_values(self, states: Floats) -> tuple[Floats, Floats]:
        """For peers: min_i Q'_i(s, a) and log pi(a|s), each [N], a sampled from the own actor."""

    def update(self, batch: Batch, peers: PeerSoftValues | None = None) -> None:
        """One gradient step of critics, actor and entropy coefficient, and a target step.

        ``peers`` replaces the soft values of rows whose next state belongs to a peer.
        """

    def update_with_noise(self, batch: Batch, noise: Floats, peers: PeerSoftValues | None = None) -> None:
        """``update`` with given standard normal noise [A, 2 B], for the actions in s, then in s'."""

    def scale_learning_rate(self, factor: float) -> None:
        """Set the learning rates to ``factor`` times the configured one."""

    def keep_alpha_above(self, floor: float) -> None:
        """Raise the entropy coefficient to at least ``floor``."""

    def losses(self) -> dict[str, float]:
        """Losses of the last update of critics and actor, and their parts; empty before the first.

        Returns:
            ``critic_loss``, ``actor_loss``, ``alpha_loss``, ``alpha`` (as used in the update), ``entropy`` (nats),
            ``value`` (mean of min_i Q_i(s, a), a from the actor) and ``target`` (mean of y).
        """

    @property
    def targets(self) -> Reals:
        """The soft targets y of the last update of critics and actor [B].

        Raises:
            RuntimeError: before the first update.
        """

    def weights(self) -> Weights:
        """Copies of all parameters: ``actor.*``, ``average.*``, ``critics.*``, ``targets.*``, ``log_alpha`` [1]."""

    def critic_weights(self) -> Weights:
        """Copies of the weights behind ``soft_values``: ``actor.*`` and ``targets.*``."""

    def load(self, weights: Mapping[str, NDArray[Any]]) -> None:
        """Load arrays from ``weights``.

        Raises:
            PolicyError: if names or shapes differ.
        """

    def optimiser_state(self) -> Weights:
        """Copies of optimiser moments and steps and the noise generator's state, for an exact resume."""

    def load_optimiser_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore from ``optimiser_state``."""
