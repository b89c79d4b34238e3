"""Counts of attempts and how they ended, for learners' schedules, the coordinator and the dashboard."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

RECENT_ATTEMPTS = 100


@dataclass
class Endings:
    """How attempts without success have ended: in an error state, with the environment, or by lack of time."""

    errors: int = 0
    terminated: int = 0
    timeouts: int = 0


class AttemptStatistics:
    """Attempts of one role so far.

    Attributes:
        attempts: attempts that have ended.
        successes: those that reached a target.
        endings: how the others ended, as far as it is one of the three ways.
    """

    def __init__(self) -> None:
        self.attempts = self.successes = 0
        self.endings = Endings()
        self._recent: deque[tuple[bool, int]] = deque(maxlen=RECENT_ATTEMPTS)

    def add(self, success: bool, steps: int) -> None:
        """Count an attempt that has ended after so many steps."""
        self.attempts += 1
        self.successes += success
        self._recent.append((success, steps))

    @property
    def recent_success(self) -> float | None:
        """Share of the last attempts that reached a target; None before the first ended."""
        return float(np.mean([success for success, _ in self._recent])) if self._recent else None

    @property
    def recent_length(self) -> float | None:
        """Mean length of the last attempts in steps."""
        return float(np.mean([steps for _, steps in self._recent])) if self._recent else None

    @property
    def recent(self) -> list[tuple[bool, int]]:
        """The last attempts as (success, steps), the oldest first."""
        return list(self._recent)

    @property
    def counts(self) -> list[int]:
        """All counts, for a checkpoint."""
        return [self.attempts, self.successes, *vars(self.endings).values()]

    def load(self, counts: Iterable[int], recent: Iterable[tuple[bool, int]]) -> None:
        """Continue from a checkpoint's ``counts`` and ``recent``; one of an earlier version has no endings."""
        self.attempts, self.successes, *endings = counts
        self.endings = Endings(*endings)
        self._recent.clear()
        self._recent.extend((success, steps) for success, steps in recent)
