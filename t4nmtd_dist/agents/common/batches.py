"""Batches that off-policy agents train on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from t4nmtd_dist.agents.common.normalisation import Normalisation
from t4nmtd_dist.agents.common.peer_values import Questions, RowNumbers

Floats = NDArray[np.float32]
States = NDArray[np.int32]


@dataclass
class Batch:
    """Experiences, float32: what one gradient step learns from.

    Attributes:
        states: product states [B, d].
        actions: as they are stored: within [-1, 1] if continuous, numbers of actions if discrete [B, A].
        rewards: sums of the discounted scaled rewards of the n steps [B].
        discounts: gamma**n, or 0 where the experience ends in a terminal [B].
        next_states: product states n steps later [B, d].
    """

    states: Tensor
    actions: Tensor
    rewards: Tensor
    discounts: Tensor
    next_states: Tensor


@dataclass(frozen=True)
class DrawnBatch:
    """A batch between its drawing and its training, as plain data; B rows, k of them across a boundary.

    Attributes:
        number: gradient steps that come before it.
        states: product states [B, d + |Q|], observations as the environment gave them.
        actions: [B, A].
        rewards: scaled n-step returns [B].
        discounts: [B].
        next_states: product states that are bootstrapped from [B, d + |Q|].
        asked_rows: rows whose value is a peer's [k].
        asked_pids: of which peer [k].
        asked_q: DFA states of these rows' next states [k].
    """

    number: int
    states: Floats
    actions: Floats
    rewards: Floats
    discounts: Floats
    next_states: Floats
    asked_rows: RowNumbers
    asked_pids: tuple[str, ...]
    asked_q: States

    def questions(self, observation_size: int) -> Questions:
        """What peers are asked about it; observations are the first ``observation_size`` numbers of a state."""
        observations = self.next_states[self.asked_rows, :observation_size]
        return Questions(self.asked_rows, self.asked_pids, observations, self.asked_q)

    def tensors(self, normalisation: Normalisation | None = None) -> Batch:
        """What the gradient step learns from, with observations as it is to see them."""
        states, next_states = self.states, self.next_states
        if normalisation is not None:
            states, next_states = map(normalisation.apply_to_states, (states, next_states))
        columns = (states, self.actions, self.rewards, self.discounts, next_states)
        return Batch(*map(torch.from_numpy, columns))
