"""Draws batches for the networks of a learner with several: each row is read as a step of one of their roles."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.off_policy_config import OffPolicyConfig
from t4nmtd_dist.agents.common.peer_success_replay import PeerSuccesses, target_symbols
from t4nmtd_dist.agents.common.product_states import with_goal
from t4nmtd_dist.agents.common.relabelling import ExperienceReader, Reading
from t4nmtd_dist.agents.common.replay_buffer import Indices, ReplayBuffer
from t4nmtd_dist.agents.common.successors import Successors, draw_successors
from t4nmtd_dist.agents.shared.role_rows import RoleRows
from t4nmtd_dist.core.config import LearnerConfig
from t4nmtd_dist.method.protocol import Method
from t4nmtd_dist.method.roles import Role

ROLES_PER_BATCH = 4
"""Roles of one network that share a batch; a batch from all of up to 56 would take many small reads."""


@dataclass(frozen=True)
class SharedBatch:
    """A batch of one network.

    Attributes:
        read: its rows, goals appended to the states.
        successors: rows that bootstrap from other roles.
    """

    read: Reading
    successors: Successors


class SharedBatches:
    """Draws batches from a replay buffer that all roles of a method write to.

    Args:
        replay: the buffer.
        role_rows: which role recorded which row.
        method: which rows a role reads, and whose value follows.
        delta: the DFA's transition table, int32 [Q, symbols].
        settings: discount and reward scale.
        config: batch size, length of returns, share of rows before successes.
        goals: length of the one-hot goal.
        rng: random generator.
    """

    def __init__(
        self,
        replay: ReplayBuffer,
        role_rows: RoleRows,
        method: Method,
        delta: NDArray[np.int32],
        settings: LearnerConfig,
        config: OffPolicyConfig,
        rng: np.random.Generator,
    ) -> None:
        self._replay, self._role_rows, self._method = replay, role_rows, method
        self._config, self._rng = config, rng
        self.roles = [method.role(name) for name in method.roles]
        self.goals = sum(role.goal is not None for role in self.roles)
        self._readings = [method.reads(role.name) for role in self.roles]
        self._readers = [
            ExperienceReader(role.tables, delta, settings.gamma, settings.reward_scale, config.n_step)
            for role in self.roles
        ]
        self._finds = [PeerSuccesses(target_symbols(role.tables, delta)) for role in self.roles]

    def rows_for(self, network: str) -> int:
        """Rows that a network can learn from."""
        return sum(self._available(number) for number in self._numbers(network))

    def _numbers(self, network: str) -> list[int]:
        return [number for number, role in enumerate(self.roles) if role.network == network]

    def _available(self, number: int) -> int:
        own = self._readings[number].rows == "own"
        return self._role_rows.count(number) if own else len(self._replay)

    def draw(self, network: str) -> SharedBatch:
        """Draw a batch for a network, which must have rows; some of its roles share it equally."""
        able = [number for number in self._numbers(network) if self._available(number)]
        chosen = self._rng.permutation(able)[:ROLES_PER_BATCH].tolist()
        sizes = np.diff(np.linspace(0, self._config.batch, len(chosen) + 1).astype(int))
        parts = [self._read(number, int(size)) for number, size in zip(chosen, sizes, strict=True)]
        read = Reading.joined([part.read for part in parts])
        offsets = np.concatenate([[0], np.cumsum(sizes)[:-1]]).tolist()
        successors = _joined([part.successors for part in parts], offsets)
        read.discounts[successors.without_value] = 0.0
        return SharedBatch(read, successors)

    def _read(self, number: int, size: int) -> SharedBatch:
        role = self.roles[number]
        if self._readings[number].rows == "own":
            rows = self._role_rows.draw(number, size, self._config.success_share, self._rng)
            q = self._replay.q[rows]
        else:
            rows = self._any_rows(number, size)
            states = self._readings[number].q
            q = states[self._rng.integers(len(states), size=size)]
        read = self._readers[number].read(self._replay, rows, q)
        successors = draw_successors(self._method, role.name, read.boundary, read.q_next, self._rng)
        return SharedBatch(self._with_goal(read, role), successors)

    def _any_rows(self, number: int, size: int) -> Indices:
        """Rows of whichever role: a share before steps that would have reached a target, the rest uniformly."""
        rows = self._replay.sample(size, 0.0, self._rng)
        wanted = round(size * self._config.success_share)
        if wanted and len(finds := self._finds[number].rows(self._replay)):
            rows[:wanted] = finds[self._rng.integers(len(finds), size=wanted)]
        return rows

    def _with_goal(self, read: Reading, role: Role) -> Reading:
        if role.goal is None:
            return read
        states, next_states = (with_goal(each, role.goal, self.goals) for each in (read.states, read.next_states))
        return replace(read, states=states, next_states=next_states)


def _joined(parts: list[Successors], offsets: list[int]) -> Successors:
    """Successors of parts that follow one another in a batch."""
    placed = list(zip(parts, offsets, strict=True))
    return Successors(
        np.concatenate([part.rows + offset for part, offset in placed]),
        tuple(pid for part in parts for pid in part.pids),
        np.concatenate([part.without_value + offset for part, offset in placed]),
    )
