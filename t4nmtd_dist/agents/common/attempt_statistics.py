"""Counts attempts and their outcomes, for exploration schedules, the coordinator and the dashboard."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

RECENT_ATTEMPTS = 100


@dataclass
class Endings:
    """Failed attempts by cause: error state, environment termination, or timeout."""

    errors: int = 0
    terminated: int = 0
    timeouts: int = 0


class AttemptStatistics:
    """Statistics of one role's attempts.

    Attributes:
        attempts: finished attempts.
        successes: attempts that reached a target.
        endings: causes of the failures, as far as one of the three applies.
    """

    def __init__(self) -> None:
        self.attempts = self.successes = 0
        self.endings = Endings()
        self._recent: deque[tuple[bool, int]] = deque(maxlen=RECENT_ATTEMPTS)

    def add(self, success: bool, steps: int) -> None:
        """Count a finished attempt and its length in steps."""
        self.attempts += 1
        self.successes += success
        self._recent.append((success, steps))

    @property
    def recent_success(self) -> float | None:
        """Success rate of the recent attempts; None before the first."""
        return float(np.mean([success for success, _ in self._recent])) if self._recent else None

    @property
    def recent_length(self) -> float | None:
        """Mean length of the recent attempts in steps; None before the first."""
        return float(np.mean([steps for _, steps in self._recent])) if self._recent else None

    @property
    def recent(self) -> list[tuple[bool, int]]:
        """The recent attempts as (success, steps), oldest first."""
        return list(self._recent)

    @property
    def counts(self) -> list[int]:
        """All counts, for a checkpoint."""
        return [self.attempts, self.successes, *vars(self.endings).values()]

    def load(self, counts: Iterable[int], recent: Iterable[tuple[bool, int]]) -> None:
        """Restore ``counts`` and ``recent``; older counts lack the endings."""
        self.attempts, self.successes, *endings = counts
        self.endings = Endings(*endings)
        self._recent.clear()
        self._recent.extend((success, steps) for success, steps in recent)
