"""What a gradient step of soft actor-critic takes, and what its two implementations have in common.

``fast_cpu`` has the fast one for the CPU, with gradients written by hand; ``torch_update`` has the plain one, for any
device. Weights and optimisers' states have the same names and shapes, so policies, checkpoints and peers' replicas go
from one to the other.
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
    """Settings of a SAC learner's gradient step; the defaults are Stable-Baselines3's unless noted.

    Attributes:
        learning_rate: of the three optimisers.
        tau: share of the critics that enters their targets at every step.
        actor_average: share of the actor that enters its running average at every step of it; the first steps count
            equally. 1 for an average that is the actor itself.
        initial_alpha: entropy coefficient to begin with; 0.1 rather than 1, which would dwarf a sparse reward.
        target_entropy: nats per action; None for minus the number of action dimensions.
        actor_every: updates of the critics for one of actor and entropy coefficient; 1 as usual, more where critics
            need many updates per interaction and the actor does not (Chen et al., 2021: REDQ).
        layer_norm: normalise the critics' hidden layers.
        hidden: widths of the hidden layers of actor and critics.
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
        rows: which rows of the batch [k].
        values: min_i Q'_i(s', a') of the peers' target critics, a' drawn from the peers' actors [k].
        log_probs: log pi(a'|s') of the peers' actors [k].
    """

    rows: NDArray[np.int64]
    values: Floats
    log_probs: Floats


class SoftActorCritic(Protocol):
    """Actor, twin critics, their targets and the entropy coefficient of one sub-task, and how a batch changes them."""

    settings: SACSettings

    def act(self, states: Floats, *, deterministic: bool) -> Floats:
        """Actions [N, A] within [-1, 1] for product states [N, d]: drawn, or the mode's."""

    def soft_values(self, states: Floats) -> tuple[Floats, Floats]:
        """What a peer is asked for: min_i Q'_i(s, a) and log pi(a|s), each [N], with a drawn from the own actor."""

    def update(self, batch: Batch, peers: PeerSoftValues | None = None) -> None:
        """One gradient step of critics, actor and entropy coefficient, and of the targets towards the critics.

        Args:
            batch: B experiences.
            peers: the soft values of rows whose next state belongs to a peer; None for none.
        """

    def update_with_noise(self, batch: Batch, noise: Floats, peers: PeerSoftValues | None = None) -> None:
        """``update`` with given noise: standard normal [A, 2 B], for the actions in s and then for those in s'."""

    def scale_learning_rate(self, factor: float) -> None:
        """Go on with ``factor`` times the learning rate of the settings."""

    def keep_alpha_above(self, floor: float) -> None:
        """Raise the entropy coefficient to ``floor`` if it has fallen below."""

    def losses(self) -> dict[str, float]:
        """Losses of the last update of critics and actor, and what they are made of; empty before the first.

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
        """Copies of everything learned: ``actor.*``, ``average.*``, ``critics.*``, ``targets.*``, ``log_alpha`` [1]."""

    def critic_weights(self) -> Weights:
        """Copies of what ``soft_values`` is computed from: ``actor.*`` and ``targets.*``."""

    def load(self, weights: Mapping[str, NDArray[Any]]) -> None:
        """Put arrays from ``weights`` into the networks.

        Raises:
            PolicyError: if names or shapes differ.
        """

    def optimiser_state(self) -> Weights:
        """Copies of the optimisers' moments and steps and of the noise generator's state, for an exact resume."""

    def load_optimiser_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from an ``optimiser_state``."""
