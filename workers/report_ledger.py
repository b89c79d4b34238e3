"""Tracks which counts were reported and answered under one lease."""

from __future__ import annotations

from t4nmtd_dist.wire.messages import LearnerStats
from t4nmtd_dist.wire.statistics import counted_since


class ReportLedger:
    """Numbers the reports under one lease and remembers their counts.

    Args:
        before: counts reported under earlier leases, which are not repeated.

    Attributes:
        newest: all counts at the newest report; None before the first.
        sequence: number of the newest report.
        answered: number of the newest answered report.
        is_last: whether the newest report is the last one.
    """

    def __init__(self, before: LearnerStats) -> None:
        self.before = before
        self.newest: LearnerStats | None = None
        self.sequence = self.answered = 0
        self.is_last = False
        self._unanswered: dict[int, LearnerStats] = {}
        self._counted: LearnerStats | None = None

    def report(self, counts: LearnerStats, *, last: bool = False) -> LearnerStats:
        """Register a report of all ``counts``; returns the counts since the lease began."""
        self.sequence += 1
        self.is_last = last
        self.newest = self._unanswered[self.sequence] = counts
        return counted_since(counts, self.before)

    def take_answer(self, sequence: int) -> None:
        """Record that the coordinator has counted all reports up to ``sequence``."""
        self.answered = max(self.answered, sequence)
        for number in [number for number in self._unanswered if number <= sequence]:
            self._counted = self._unanswered.pop(number)

    def counted(self, now: LearnerStats) -> LearnerStats:
        """The counts that the coordinator has counted or will count under this lease; ``now`` is everything."""
        if self.is_last and self.answered < self.sequence:
            return self._counted or self.before
        return now
