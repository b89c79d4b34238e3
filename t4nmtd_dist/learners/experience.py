"""Replay of letters: experience that can be read for any DFA state (exact relabelling), with n-step returns.

A row holds what the world did: <s, a, letter, s'>. What that means for the task (q', reward, boundary) follows from
the DFA state in which one reads it, so it is computed when a batch is drawn, never stored. An experience thus serves
every DFA state in which the sub-task has a transition, and no reward is guessed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.product import SubtaskTables
from t4nmtd_dist.worlds import Observations

Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]
BEFORE_SUCCESS = 60


@dataclass(frozen=True)
class Returns:
    """n-step returns of a batch, cut at the first change of the DFA state.

    Attributes:
        reward: sum of gamma^i r_i, float64 [B], unscaled.
        discount: gamma^k of the bootstrap after k steps, 0 at terminals, float64 [B].
        last: rows [B] (flat) whose s' is bootstrapped from.
        q_next: DFA state of the bootstrap, int32 [B].
        boundary: the DFA state changed, to one outside F and E: the value is the peer's, bool [B].
    """

    reward: NDArray[np.float64]
    discount: NDArray[np.float64]
    last: Indices
    q_next: NDArray[np.int32]
    boundary: Flags


class Experience:
    """A ring of ``steps`` time steps of N copies of the world; flat row number = step * N + copy.

    Args:
        steps: time steps kept.
        count: N.
        observation_size: d.
        action_size: A.
    """

    def __init__(self, steps: int, count: int, observation_size: int, action_size: int) -> None:
        self._steps, self._count = steps, count
        rows = steps * count
        self.observations = np.zeros((rows, observation_size), np.float32)
        self.next_observations = np.zeros((rows, observation_size), np.float32)
        self.actions = np.zeros((rows, action_size), np.float32)
        self.q = np.zeros(rows, np.int32)
        self.letters = np.zeros(rows, np.int64)
        self.terminated = np.zeros(rows, np.bool_)
        self.ended = np.ones(rows, np.bool_)
        self._written = 0
        self._began = np.zeros(count, np.int64)
        self._successes = np.zeros(rows, np.int64)
        self._success_stamps = np.full(rows, -1, np.int64)
        self._success_count = 0

    def __len__(self) -> int:
        return min(self._written, self._steps) * self._count

    def add(
        self,
        observations: Observations,
        q: NDArray[np.int32],
        actions: NDArray[np.float32],
        letters: NDArray[np.int64],
        next_observations: Observations,
        terminated: Flags,
        ended: Flags,
        reached: Flags,
    ) -> None:
        """Store one step of all copies; arrays begin with the axis N.

        ``ended`` says that the copy's next step belongs to another attempt, ``reached`` that the attempt succeeded.
        """
        first = (self._written % self._steps) * self._count
        rows = slice(first, first + self._count)
        self.observations[rows], self.next_observations[rows] = observations, next_observations
        self.actions[rows], self.q[rows], self.letters[rows] = actions, q, letters
        self.terminated[rows], self.ended[rows] = terminated, ended
        for copy in np.flatnonzero(reached):
            self._remember_success(int(copy))
        self._written += 1
        self._began[ended] = self._written

    def _remember_success(self, copy: int) -> None:
        """Index the last steps before a success."""
        first = max(int(self._began[copy]), self._written - BEFORE_SUCCESS + 1)
        stamps = np.arange(first, self._written + 1)
        places = (self._success_count + np.arange(len(stamps))) % len(self._successes)
        self._successes[places] = (stamps % self._steps) * self._count + copy
        self._success_stamps[places] = stamps
        self._success_count += len(stamps)

    def sample(self, size: int, success_share: float, rng: np.random.Generator) -> Indices:
        """Row numbers [size]: a share from the steps before past successes, the rest uniform."""
        rows = rng.integers(len(self), size=size)
        wanted = int(size * success_share)
        if wanted and self._success_count:
            places = rng.integers(min(self._success_count, len(self._successes)), size=wanted)
            fresh = self._success_stamps[places] > self._written - 1 - self._steps
            rows[:wanted] = np.where(fresh, self._successes[places], rows[:wanted])
        return rows

    def returns(
        self, rows: Indices, q: NDArray[np.int32], tables: SubtaskTables, delta: NDArray[np.int32], gamma: float, n: int
    ) -> Returns:
        """n-step returns of ``rows`` read in DFA states ``q``.

        A return ends early where the DFA state changes, the attempt or the environment ends, or the ring ends.
        """
        size = len(rows)
        reward, discount = np.zeros(size), np.ones(size)
        last, q_next = rows.copy(), q.astype(np.int32)
        going = np.ones(size, np.bool_)
        newest = ((self._written - 1) % self._steps) * self._count
        row = rows.copy()
        for _ in range(n):
            reached = delta[q, self.letters[row]]
            gained = tables.reward[q, reached] - np.where(self.terminated[row], tables.kept_potential[reached], 0.0)
            reward += np.where(going, discount * gained, 0.0)
            discount = np.where(going, discount * gamma, discount)
            last, q_next = np.where(going, row, last), np.where(going, reached, q_next)
            going &= ~((reached != q) | self.ended[row] | (row >= newest) & (row < newest + self._count))
            if not going.any():
                break
            row = np.where(going, (row + self._count) % len(self.q), row)
        terminal = tables.terminal[q_next] | self.terminated[last]
        return Returns(reward, np.where(terminal, 0.0, discount), last, q_next, (q_next != q) & ~terminal)

    def state(self) -> dict[str, NDArray[Any]]:
        """Everything needed to go on, as arrays."""
        kept = {name: array[: len(self)] for name, array in self._columns().items()}
        kept["counters"] = np.array([self._written, self._success_count], np.int64)
        return kept | {"began": self._began, "successes": self._successes, "success_stamps": self._success_stamps}

    def load(self, state: dict[str, NDArray[Any]]) -> None:
        """Go on from ``state``."""
        for name, array in self._columns().items():
            array[: len(state[name])] = state[name]
        self._written, self._success_count = (int(x) for x in state["counters"])
        self._began[:], self._successes[:] = state["began"], state["successes"]
        self._success_stamps[:] = state["success_stamps"]

    def _columns(self) -> dict[str, NDArray[Any]]:
        return {
            "observations": self.observations,
            "next_observations": self.next_observations,
            "actions": self.actions,
            "q": self.q,
            "letters": self.letters,
            "terminated": self.terminated,
            "ended": self.ended,
        }
