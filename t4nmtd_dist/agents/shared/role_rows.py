"""Which role recorded which row of a shared replay buffer."""

from __future__ import annotations

from typing import Any

import numpy as np

from t4nmtd_dist.agents.common.replay_buffer import Indices, ReplayBuffer, RowSet
from t4nmtd_dist.method.protocol import Mask, States

NOBODY = -1


class RoleRows:
    """The rows of each of R roles in a replay buffer, and those that led one of them to a target.

    Args:
        replay: the buffer; ``record`` follows each of its ``add``.
        roles: R.
    """

    def __init__(self, replay: ReplayBuffer, roles: int) -> None:
        self._replay = replay
        rows = len(replay.q)
        self._role: States = np.full(rows, NOBODY, np.int32)
        self._own = [RowSet(rows) for _ in range(roles)]
        self._before_target = [RowSet(rows) for _ in range(roles)]

    def record(self, roles: States, reached: Mask) -> None:
        """The newest step of every copy was made by ``roles`` [N], and reached a target of theirs or not [N]."""
        rows = self._replay.rows_of(self._replay.written - 1, 1)[0]
        for role in np.unique(self._role[rows]):
            if role != NOBODY:
                overwritten = rows[self._role[rows] == role]
                self._own[role].discard(overwritten)
                self._before_target[role].discard(overwritten)
        self._role[rows] = roles
        for role in np.unique(roles):
            self._own[role].add(rows[roles == role])
        for copy in np.flatnonzero(reached):
            self._before_target[roles[copy]].add(self._leading_to_newest(int(copy), int(roles[copy])))

    def _leading_to_newest(self, copy: int, role: int) -> Indices:
        """The last rows of the role's turn, latest first."""
        rows = self._replay.leading_to(self._replay.written - 1, copy)
        others = np.flatnonzero(self._role[rows] != role)
        return rows[: others[0]] if len(others) else rows

    def count(self, role: int) -> int:
        """Number of rows that a role recorded."""
        return len(self._own[role])

    def draw(self, role: int, size: int, success_share: float, rng: np.random.Generator) -> Indices:
        """Rows that a role recorded [size]: a share of those before a target, if any, the rest uniformly."""
        rows = self._own[role].draw(size, rng)
        wanted = round(size * success_share)
        if wanted and len(self._before_target[role]):
            rows[:wanted] = self._before_target[role].draw(wanted, rng)
        return rows

    def state_dict(self) -> dict[str, Any]:
        """State for a checkpoint; the members of every set keep their order."""
        return {
            "role": self._role[: len(self._replay)].copy(),
            "own": [rows.members.copy() for rows in self._own],
            "before_target": [rows.members.copy() for rows in self._before_target],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore from ``state_dict``, after the replay buffer."""
        self._role[:] = NOBODY
        self._role[: len(state["role"])] = state["role"]
        for name, sets in (("own", self._own), ("before_target", self._before_target)):
            for number, members in enumerate(state[name]):
                sets[number] = RowSet(len(self._role))
                sets[number].add(members)
