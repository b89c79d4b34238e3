"""The coordinator's record of each learner, across leases."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec
from numpy.typing import NDArray

from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.method.start_states import InitialStateBuffer
from t4nmtd_dist.wire.fields import LARGEST_COUNT
from t4nmtd_dist.wire.messages import LearnerStats
from t4nmtd_dist.wire.statistics import added, rated

RATE_WINDOW_S = 10.0


@dataclass
class LearnerRecord:
    """The record of one sub-task's learner.

    Attributes:
        buffer: the sub-task's initial-state buffer.
        sequence: number of the last batch of progress applied in this epoch.
        earlier: counts of finished epochs.
        current: counts of this epoch.
        version: version of the newest weights; 0 for none.
        lost: whether the expiry of its lease was logged.
        complained: whether invalid data was logged under this lease.
        unusable: whether its newest weights were rejected.
    """

    buffer: InitialStateBuffer
    sequence: int = 0
    earlier: LearnerStats = field(default_factory=LearnerStats)
    current: LearnerStats = field(default_factory=LearnerStats)
    version: int = 0
    weights: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    lost: bool = False
    complained: bool = False
    unusable: bool = False
    _history: deque[tuple[float, LearnerStats]] = field(default_factory=deque)

    @property
    def interactions(self) -> int:
        """Environment steps over all epochs."""
        return min(self.earlier.interactions + self.current.interactions, LARGEST_COUNT)

    @property
    def total(self) -> LearnerStats:
        """Counts over all epochs; other values are the newest."""
        return added(self.earlier, self.current)

    def state_dict(self) -> State:
        """The state for a checkpoint; weights are not copied."""
        return {
            "buffer": self.buffer.state_dict(),
            "sequence": self.sequence,
            "earlier": msgspec.to_builtins(self.earlier),
            "current": msgspec.to_builtins(self.current),
            "version": self.version,
            "weights": dict(self.weights),
        }

    def load_state_dict(self, state: State) -> None:
        """Restore from ``state_dict``."""
        self.buffer.load_state_dict(state["buffer"])
        self.earlier = msgspec.convert(state["earlier"], LearnerStats)
        self.current = msgspec.convert(state["current"], LearnerStats)
        self.sequence, self.version, self.weights = state["sequence"], state["version"], state["weights"]

    def raise_counts(self, total: LearnerStats) -> None:
        """Include interactions made since the loaded checkpoint."""
        if total.interactions >= self.total.interactions:
            self.earlier, self.current = total, LearnerStats()

    def begin_epoch(self) -> None:
        """Start a new lease: keep earlier counts, count from zero."""
        self.earlier = self.total
        self.current = LearnerStats()
        self.sequence = 0
        self.lost = self.complained = self.unusable = False
        self._history.clear()

    def update(self, stats: LearnerStats, now: float) -> None:
        """Store the newest counts of this epoch."""
        self.current = stats
        self._history.append((now, stats))
        while self._history[0][0] < now - RATE_WINDOW_S:
            self._history.popleft()

    def rates(self) -> dict[str, float]:
        """Shown rates: counters per second over the last ten seconds, by name."""
        if len(self._history) < 2:
            return dict.fromkeys(rated(), 0.0)
        (then, before), (now, newest) = self._history[0], self._history[-1]
        span = max(now - then, 1e-9)
        return {name: (getattr(newest, name) - getattr(before, name)) / span for name in rated()}


def interactions(records: Mapping[str, LearnerRecord]) -> int:
    """Environment steps over all epochs."""
    return sum(record.interactions for record in records.values())


def processor_s(records: Mapping[str, LearnerRecord]) -> float:
    """CPU time of all learners in seconds."""
    return sum(record.total.processor_s for record in records.values())
