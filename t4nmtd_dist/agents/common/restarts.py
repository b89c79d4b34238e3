"""Begins attempts: with the environment's reset, or by restoring a start state."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.environments.batched import BatchedEnv, Observations, Rows
from t4nmtd_dist.method.start_states import InitialStateBuffer, StartState

MOST_FAILURES = 50


class Restarts:
    """Begins attempts, and drops start states that cannot be restored.

    Args:
        env: the environments.
        buffer: the role's start states.
        draw: draws the given number of starts; empty if there are none.
        rng: seeds the environments.

    Attributes:
        seeded: environments seeded by their first reset, bool [N].
        tell: called with a message about the first start state that cannot be restored.
    """

    def __init__(
        self,
        env: BatchedEnv,
        buffer: InitialStateBuffer,
        draw: Callable[[int], Sequence[StartState]],
        rng: np.random.Generator,
    ) -> None:
        self._env, self._buffer, self._draw, self.rng = env, buffer, draw, rng
        self.seeded: NDArray[np.bool_] = np.zeros(env.count, dtype=np.bool_)
        self.tell: Callable[[str], None] = print
        self._told = False
        self._failures = 0  # consecutive failures to restore
        self._restored: StartState | None = None

    def begin(self, rows: Rows, observations: Observations) -> list[StartState]:
        """Begin an attempt in each of these environments.

        Args:
            rows: their numbers [k].
            observations: float32 [N, d]; ``rows`` are overwritten.

        Returns:
            The start of each [k]; empty if there is none.

        Raises:
            EnvError: after ``MOST_FAILURES`` consecutive failures to restore: the environment is at fault.
        """
        starts = list(self._draw(len(rows)))
        if not starts:
            return []
        fresh = np.array([start.state is None for start in starts])
        self._reset(rows[fresh], observations)
        return starts if self._restore(rows, starts, np.flatnonzero(~fresh), observations) else []

    def _reset(self, rows: Rows, observations: Observations) -> None:
        """Reset environments; the first reset of each seeds its generator."""
        for part, first in ((rows[~self.seeded[rows]], True), (rows[self.seeded[rows]], False)):
            if len(part):
                seed = int(self.rng.integers(2**31)) if first else None
                observations[part] = self._env.reset(part, seed)
                self.seeded[part] = True

    def _restore(self, rows: Rows, starts: list[StartState], places: Rows, observations: Observations) -> bool:
        """Restore ``rows[places]``, together if possible; replaces failing starts in ``starts``.

        Returns:
            False if there is no replacement.
        """
        if not len(places):
            return True
        try:
            self._restore_all(rows[places], [starts[place] for place in places], observations)
            return True
        except Exception:  # environments may raise anything for a foreign state
            return all(self._restore_one(rows, starts, place, observations) for place in places)

    def _restore_all(self, rows: Rows, starts: list[StartState], observations: Observations) -> None:
        found = self._env.restore(rows, [start.state for start in starts if start.state is not None])
        if not np.isfinite(found).all():
            raise EnvError("its observation holds NaN or infinity")
        observations[rows] = found
        self._failures, self._restored = 0, starts[-1]

    def _restore_one(self, rows: Rows, starts: list[StartState], place: int, observations: Observations) -> bool:
        row = rows[place : place + 1]
        while starts[place].state is not None:
            try:
                self._restore_all(row, [starts[place]], observations)
                return True
            except Exception as error:
                self._drop(starts[place], error)
            another = next(iter(self._draw(1)), self._restored)
            if another is None:
                return False
            starts[place] = another
        self._reset(row, observations)
        return True

    def _drop(self, start: StartState, error: Exception) -> None:
        """Remove an unusable start state; report the first."""
        self._failures += 1
        if self._failures >= MOST_FAILURES:
            raise EnvError(
                f"{self._failures} start states in a row could not be restored, the last for {type(error).__name__}: "
                f"{error}; mend how the environment restores states (t4nmtd check), or choose another way (snapshots)"
            ) from error
        if start.state is not None:
            self._buffer.remove(start.q, start.state)
        if not self._told:
            self._told = True
            self.tell(f"a start state of DFA state {start.q} is dropped, for it cannot be restored: {error}")
