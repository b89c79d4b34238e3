"""Batches for off-policy agents."""

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
    """Transitions for one gradient step, float32.

    Attributes:
        states: product states [B, d + |Q|].
        actions: within [-1, 1] if continuous, indices if discrete [B, A].
        rewards: scaled n-step returns [B].
        discounts: gamma**n, or 0 at terminals [B].
        next_states: product states n steps later [B, d + |Q|].
    """

    states: Tensor
    actions: Tensor
    rewards: Tensor
    discounts: Tensor
    next_states: Tensor

    @classmethod
    def of(cls, states: Floats, actions: Floats, rewards: Floats, discounts: Floats, next_states: Floats) -> Batch:
        """The batch of these arrays."""
        return cls(*map(torch.from_numpy, (states, actions, rewards, discounts, next_states)))


@dataclass(frozen=True)
class DrawnBatch:
    """A drawn batch waiting for its update; B rows, k of them across a boundary.

    Attributes:
        number: number of gradient steps before it.
        states: product states with raw observations [B, d + |Q|].
        actions: [B, A].
        rewards: scaled n-step returns [B].
        discounts: [B].
        next_states: bootstrap product states [B, d + |Q|].
        asked_rows: rows that bootstrap from a peer [k].
        asked_pids: their peers [k].
        asked_q: DFA states of their next states [k].
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
        """Queries to peers; ``observation_size`` is d."""
        observations = self.next_states[self.asked_rows, :observation_size]
        return Questions(self.asked_rows, self.asked_pids, observations, self.asked_q)

    def tensors(self, normalisation: Normalisation | None = None) -> Batch:
        """The batch as tensors, with normalised observations."""
        states, next_states = self.states, self.next_states
        if normalisation is not None:
            states, next_states = map(normalisation.apply_to_states, (states, next_states))
        return Batch.of(states, self.actions, self.rewards, self.discounts, next_states)
