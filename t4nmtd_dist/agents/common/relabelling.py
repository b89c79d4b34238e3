"""Exact relabelling: reads a replay row in any DFA state of a sub-task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.product_states import product_states
from t4nmtd_dist.agents.common.replay_buffer import ReplayBuffer
from t4nmtd_dist.method.rewards import SubtaskTables

Floats = NDArray[np.float32]
States = NDArray[np.int32]


@dataclass(frozen=True)
class Reading:
    """Replay rows read for a sub-task: columns of a batch, and where it hands over.

    Attributes:
        states: product states [B, d + |Q|].
        actions: [B, A].
        rewards: scaled n-step returns [B].
        discounts: of the bootstrap, 0 at terminals [B].
        next_states: bootstrap product states [B, d + |Q|].
        q_next: their DFA states [B].
        boundary: DFA change to a state outside F and E [B].
    """

    states: Floats
    actions: Floats
    rewards: Floats
    discounts: Floats
    next_states: Floats
    q_next: States
    boundary: NDArray[np.bool_]

    @classmethod
    def joined(cls, parts: Sequence[Reading]) -> Reading:
        """Concatenate readings."""
        if len(parts) == 1:
            return parts[0]
        return cls(*(np.concatenate(columns) for columns in zip(*(vars(part).values() for part in parts), strict=True)))


@dataclass(frozen=True)
class ExperienceReader:
    """Relabels replay rows for one sub-task.

    Attributes:
        delta: the DFA's transition table, int32 [Q, symbols].
        gamma: discount per step.
        reward_scale: reward factor.
        n_step: maximum number of steps in a return.
    """

    tables: SubtaskTables
    delta: NDArray[np.int32]
    gamma: float
    reward_scale: float
    n_step: int

    def read(self, experience: ReplayBuffer, rows: NDArray[np.int64], q: States) -> Reading:
        """Read rows [B] of a replay buffer in DFA states ``q`` [B]."""
        returns = experience.returns(rows, q, self.tables, self.delta, self.gamma, self.n_step)
        states = len(self.delta)
        return Reading(
            states=product_states(experience.observations[rows], q, states),
            actions=experience.actions[rows],
            rewards=(returns.reward * self.reward_scale).astype(np.float32),
            discounts=returns.discount.astype(np.float32),
            next_states=product_states(experience.next_observations[returns.last], returns.q_next, states),
            q_next=returns.q_next.astype(np.int32),
            boundary=returns.boundary,
        )
