"""What the coordinator knows of each learner, across all leases on its sub-task."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec
from numpy.typing import NDArray

from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.method.start_states import InitialStateBuffer
from t4nmtd_dist.wire.fields import LARGEST_AMOUNT, LARGEST_COUNT
from t4nmtd_dist.wire.messages import Intervention, LearnerStats

RATE_WINDOW_S = 10.0


def _sum(a: int, b: int) -> int:
    """A sum of two counts, no larger than what every format here can hold."""
    return min(a + b, LARGEST_COUNT)


def add_interventions(a: Intervention, b: Intervention) -> Intervention:
    """Sums of two counts."""
    return Intervention(
        asked=_sum(a.asked, b.asked),
        answered=_sum(a.answered, b.answered),
        late=_sum(a.late, b.late),
        own_used=_sum(a.own_used, b.own_used),
        lag_total=_sum(a.lag_total, b.lag_total),
    )


@dataclass
class LearnerRecord:
    """One sub-task's learner.

    Attributes:
        buffer: the sub-task's initial-state buffer.
        sequence: number of the last batch of progress applied in this epoch.
        earlier: counts of finished epochs.
        current: counts of this epoch.
        version: newest weights held, 0 for none.
    """

    buffer: InitialStateBuffer
    sequence: int = 0
    earlier: LearnerStats = field(default_factory=LearnerStats)
    current: LearnerStats = field(default_factory=LearnerStats)
    version: int = 0
    weights: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    _history: deque[tuple[float, int, int]] = field(default_factory=deque)

    @property
    def interactions(self) -> int:
        """Environment steps over all epochs."""
        return _sum(self.earlier.interactions, self.current.interactions)

    @property
    def total(self) -> LearnerStats:
        """Counts over all epochs; rates and phases are the newest."""
        a, b = self.earlier, self.current
        return LearnerStats(
            phase=b.phase,
            interactions=_sum(a.interactions, b.interactions),
            gradient_steps=_sum(a.gradient_steps, b.gradient_steps),
            attempts=_sum(a.attempts, b.attempts),
            successes=_sum(a.successes, b.successes),
            recent_success=b.recent_success,
            episode_steps=b.episode_steps,
            entropy=b.entropy,
            value_loss=b.value_loss,
            peer_rows=b.peer_rows,
            processor_s=min(a.processor_s + b.processor_s, LARGEST_AMOUNT),
            errors=min(a.errors + b.errors, LARGEST_COUNT),
            timeouts=min(a.timeouts + b.timeouts, LARGEST_COUNT),
            terminated=min(a.terminated + b.terminated, LARGEST_COUNT),
            intervention=add_interventions(a.intervention, b.intervention),
        )

    def state_dict(self) -> State:
        """Everything, for a checkpoint; the weights are the very arrays that are held."""
        return {
            "buffer": self.buffer.state_dict(),
            "sequence": self.sequence,
            "earlier": msgspec.to_builtins(self.earlier),
            "current": msgspec.to_builtins(self.current),
            "version": self.version,
            "weights": dict(self.weights),
        }

    def load_state_dict(self, state: State) -> None:
        """Go on from a ``state``."""
        self.buffer.load_state_dict(state["buffer"])
        self.earlier = msgspec.convert(state["earlier"], LearnerStats)
        self.current = msgspec.convert(state["current"], LearnerStats)
        self.sequence, self.version, self.weights = state["sequence"], state["version"], state["weights"]

    def raise_counts(self, total: LearnerStats) -> None:
        """Count at least this much: what was spent after the checkpoint that the rest comes from."""
        if total.interactions >= self.total.interactions:
            self.earlier, self.current = total, LearnerStats()

    def begin_epoch(self) -> None:
        """A new lease: earlier counts are kept, the new worker counts from zero."""
        self.earlier = self.total
        self.current = LearnerStats()
        self.sequence = 0
        self._history.clear()

    def update(self, stats: LearnerStats, now: float) -> None:
        """Newest counts of this epoch."""
        self.current = stats
        self._history.append((now, stats.interactions, stats.gradient_steps))
        while self._history[0][0] < now - RATE_WINDOW_S:
            self._history.popleft()

    def rates(self) -> tuple[float, float]:
        """Environment steps and gradient steps per second over the last ten seconds."""
        if len(self._history) < 2:
            return 0.0, 0.0
        (then, steps, updates), (now, steps_now, updates_now) = self._history[0], self._history[-1]
        span = max(now - then, 1e-9)
        return (steps_now - steps) / span, (updates_now - updates) / span
