"""Which of a learner's counts the coordinator was told, and which of these it has answered, under one lease."""

from __future__ import annotations

from t4nmtd_dist.wire.messages import LearnerStats
from t4nmtd_dist.wire.statistics import counted_since


class ReportLedger:
    """Numbers the reports under one lease and remembers what each of them said.

    Args:
        before: counts that were reported under earlier leases, and are not reported again.

    Attributes:
        before: see above.
        newest: all counts as of the newest report; None before the first.
        sequence: number of the newest report.
        answered: number of the newest report that the coordinator has answered.
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
        """Enter the next report of all ``counts``; what it says, counted since the lease began."""
        self.sequence += 1
        self.is_last = last
        self.newest = self._unanswered[self.sequence] = counts
        return counted_since(counts, self.before)

    def take_answer(self, sequence: int) -> None:
        """The coordinator has counted all reports up to this one."""
        self.answered = max(self.answered, sequence)
        for number in [number for number in self._unanswered if number <= sequence]:
            self._counted = self._unanswered.pop(number)

    def counted(self, now: LearnerStats) -> LearnerStats:
        """Counts that the coordinator has counted, or will while this lease lasts; ``now`` is all there is."""
        if self.is_last and self.answered < self.sequence:
            return self._counted or self.before
        return now
