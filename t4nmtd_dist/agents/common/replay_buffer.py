"""Symbol replay: transitions readable in any DFA state (exact relabelling), with n-step returns.

A row holds what the environment did: <s, a, symbol, s'>. Its task meaning (q', reward, boundary) depends on the DFA
state it is read in, so it is computed when a batch is drawn. One row thus serves every DFA state of the sub-task with
exact rewards, and peers' sub-tasks too (docs/decisions/016): ``since`` exports rows, ``extend`` imports another
learner's.
"""

from __future__ import annotations

import threading
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.environments.batched import Observations
from t4nmtd_dist.method.rewards import SubtaskTables

Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]
BEFORE_SUCCESS = 60
SHARED = ("observations", "next_observations", "actions", "symbols", "terminated", "ended")


@dataclass(frozen=True)
class Returns:
    """n-step returns of a batch, cut at the first DFA change.

    Attributes:
        reward: sum of gamma^i r_i, float64 [B], unscaled.
        discount: gamma^k after k steps, 0 at terminals, float64 [B].
        last: flat rows whose s' is the bootstrap state [B].
        q_next: DFA state of the bootstrap, int32 [B].
        boundary: DFA change to a state outside F and E, so the value is the peer's, bool [B].
    """

    reward: NDArray[np.float64]
    discount: NDArray[np.float64]
    last: Indices
    q_next: NDArray[np.int32]
    boundary: Flags


class RowSet:
    """A set of rows to sample from; adding or removing a row takes constant time.

    Args:
        rows: number of existing rows.
    """

    def __init__(self, rows: int) -> None:
        self._members = np.zeros(rows, np.int64)
        self._place = np.full(rows, -1, np.int64)  # index of a row in the members, or -1
        self._size = 0

    def __len__(self) -> int:
        return self._size

    @property
    def members(self) -> Indices:
        """The rows in the order in which ``draw`` indexes them; a view."""
        return self._members[: self._size]

    def add(self, rows: Indices) -> None:
        """Add rows that are not yet members."""
        rows = rows[self._place[rows] < 0]
        places = np.arange(self._size, self._size + len(rows))
        self._members[places], self._place[rows] = rows, places
        self._size += len(rows)

    def discard(self, rows: Indices) -> None:
        """Remove rows that are members; the last member takes the place of each."""
        for row in rows[self._place[rows] >= 0]:
            place, self._size = self._place[row], self._size - 1
            last = self._members[self._size]
            self._members[place], self._place[last] = last, place
            self._place[row] = -1

    def draw(self, count: int, rng: np.random.Generator) -> Indices:
        """Draw members uniformly with replacement [count]; the set must not be empty."""
        return self._members[rng.integers(self._size, size=count)]


class ReplayBuffer:
    """A ring of ``steps`` time steps of N environments; flat row = (step modulo ``steps``) * N + copy.

    Args:
        steps: capacity in time steps, at least one.
        count: N.
        observation_size: d.
        action_size: A.

    Attributes:
        origin: unique per object, so that readers notice a replaced buffer.
    """

    def __init__(self, steps: int, count: int, observation_size: int, action_size: int) -> None:
        self.origin = uuid.uuid4().hex
        self.steps, self._count = steps, count
        rows = steps * count
        self.observations = np.zeros((rows, observation_size), np.float32)
        self.next_observations = np.zeros((rows, observation_size), np.float32)
        self.actions = np.zeros((rows, action_size), np.float32)
        self.q = np.zeros(rows, np.int32)
        self.symbols = np.zeros(rows, np.int64)
        self.terminated = np.zeros(rows, np.bool_)
        self.ended = np.ones(rows, np.bool_)
        self._written = 0
        self._before_success = RowSet(rows)
        self._lock = threading.Lock()  # guards the data that ``since`` reads from another thread

    def __len__(self) -> int:
        return min(self._written, self.steps) * self._count

    def alike(self, steps: int) -> ReplayBuffer:
        """An empty buffer for rows of the same shapes."""
        return ReplayBuffer(steps, self._count, self.observations.shape[1], self.actions.shape[1])

    @property
    def written(self) -> int:
        """Steps stored so far, overwritten ones included."""
        return self._written

    def add(
        self,
        observations: Observations,
        q: NDArray[np.int32],
        actions: NDArray[np.float32],
        symbols: NDArray[np.int64],
        next_observations: Observations,
        terminated: Flags,
        ended: Flags,
        reached: Flags,
    ) -> None:
        """Store one step of all environments; the first axis of every array is N.

        ``ended`` marks the last step of an attempt, ``reached`` a success.
        """
        rows = self.rows_of(self._written, 1)[0]
        self._before_success.discard(rows)
        with self._lock:
            self.observations[rows], self.next_observations[rows] = observations, next_observations
            self.actions[rows], self.q[rows], self.symbols[rows] = actions, q, symbols
            self.terminated[rows], self.ended[rows] = terminated, ended
            self._written += 1
        for copy in np.flatnonzero(reached):
            self._before_success.add(self.leading_to(self._written - 1, int(copy)))

    def end_attempts(self) -> None:
        """The next step of every copy belongs to another attempt."""
        if self._written:
            with self._lock:
                self.ended[self.rows_of(self._written - 1, 1)] = True

    def rows_of(self, first: int, steps: int) -> Indices:
        """Flat row numbers of steps [steps, N]."""
        return ((first + np.arange(steps)) % self.steps)[:, None] * self._count + np.arange(self._count)

    def since(self, step: int, most_bytes: int) -> tuple[int, dict[str, NDArray[Any]]]:
        """Copies of the kept steps from number ``step`` on; thread-safe.

        Args:
            step: counted from 0, overwritten steps included.
            most_bytes: maximum size, but at least one step.

        Returns:
            The number of the first step, and the columns named in ``SHARED`` [T, N, ...]; T is 0 if there are none.
        """
        with self._lock:
            first = min(max(step, self._written - self.steps, 0), self._written)
            columns = self._shared()
            size = sum(column[: self._count].nbytes for column in columns.values())
            rows = self.rows_of(first, min(self._written - first, max(1, most_bytes // size)))
            return first, {name: column[rows] for name, column in columns.items()}

    def extend(self, columns: Mapping[str, NDArray[Any]], *, follows: bool) -> None:
        """Store steps of another learner, without DFA states and successes.

        Args:
            columns: from ``since`` of a buffer of the same shapes.
            follows: whether they directly follow the last stored steps; if not, open attempts are marked as ended.
        """
        steps = min(len(columns["symbols"]), self.steps)
        rows = self.rows_of(self._written, steps)
        self._before_success.discard(rows.ravel())
        with self._lock:
            if not follows and self._written:
                self.ended[self.rows_of(self._written - 1, 1)] = True
            for name, column in self._shared().items():
                column[rows] = columns[name][len(columns[name]) - steps :]
            self._written += steps

    def _shared(self) -> dict[str, NDArray[Any]]:
        return {name: getattr(self, name) for name in SHARED}

    def leading_to(self, step: int, copy: int) -> Indices:
        """Kept rows of the last steps of an attempt up to ``step``, latest first."""
        kept = min(self._written, self.steps) - (self._written - 1 - step)
        rows = (step - np.arange(min(BEFORE_SUCCESS, kept))) % self.steps * self._count + copy
        earlier_attempt = np.flatnonzero(self.ended[rows[1:]])
        return rows[: earlier_attempt[0] + 1] if len(earlier_attempt) else rows

    def sample(self, size: int, success_share: float, rng: np.random.Generator) -> Indices:
        """Draw row numbers [size]: a share from before successes, if any, the rest uniformly."""
        rows = rng.integers(len(self), size=size)
        wanted = round(size * success_share)
        if wanted and len(self._before_success):
            rows[:wanted] = self._before_success.draw(wanted, rng)
        return rows

    def returns(
        self, rows: Indices, q: NDArray[np.int32], tables: SubtaskTables, delta: NDArray[np.int32], gamma: float, n: int
    ) -> Returns:
        """n-step returns of ``rows`` read in DFA states ``q``.

        They end early at a DFA change and at the end of the attempt, the episode or the ring.
        """
        size = len(rows)
        reward, discount = np.zeros(size), np.ones(size)
        last, q_next = rows.copy(), q.astype(np.int32)
        going = np.ones(size, np.bool_)
        newest = ((self._written - 1) % self.steps) * self._count
        row = rows.copy()
        for _ in range(n):
            reached = delta[q, self.symbols[row]]
            gained = tables.transition_rewards(q, reached, self.terminated[row])
            reward += np.where(going, discount * gained, 0.0)
            discount = np.where(going, discount * gamma, discount)
            last, q_next = np.where(going, row, last), np.where(going, reached, q_next)
            is_newest = (row >= newest) & (row < newest + self._count)
            going &= ~((reached != q) | self.ended[row] | is_newest)
            if not going.any():
                break
            row = np.where(going, (row + self._count) % len(self.q), row)
        terminal = tables.terminals(q_next, self.terminated[last])
        return Returns(reward, np.where(terminal, 0.0, discount), last, q_next, (q_next != q) & ~terminal)

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """State as arrays; views of the filled part, to be written before the next ``add``."""
        filled = {name: column[: len(self)] for name, column in self._columns().items()}
        written = np.array(self._written, np.int64)
        return filled | {"written": written, "before_success": self._before_success.members}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore from ``state_dict``.

        Raises:
            RunError: if the capacity, the number of environments or the shapes differ.
        """
        filled = min(int(state["written"]), self.steps) * self._count
        shapes = {name: (filled, *column.shape[1:]) for name, column in self._columns().items()}
        for name, shape in shapes.items():
            if state[name].shape != shape:
                raise RunError(f"replay: {name} has shape {state[name].shape}, expected {shape}")
        for name, column in self._columns().items():
            column[:filled] = state[name]
        self._written = int(state["written"])
        self._before_success = RowSet(len(self.q))
        self._before_success.add(state["before_success"])

    def _columns(self) -> dict[str, NDArray[Any]]:
        return {
            "observations": self.observations,
            "next_observations": self.next_observations,
            "actions": self.actions,
            "q": self.q,
            "symbols": self.symbols,
            "terminated": self.terminated,
            "ended": self.ended,
        }
