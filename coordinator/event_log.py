"""A run's clock and event log."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from coordinator.events import LogEvent
from t4nmtd_dist.wire.messages import EventLine

EVENTS_KEPT = 50


@dataclass
class RunClock:
    """The time of a run, driven by its events.

    Attributes:
        now: time of the newest event, seconds of the coordinator's monotonic clock.
        earlier_s: seconds that the run took before it was resumed.
    """

    now: float = 0.0
    earlier_s: float = 0.0
    _began: float | None = None
    _ended: float | None = None

    def advance(self, now: float) -> None:
        """Advance to an event's time; the first starts the run."""
        self.now = now
        if self._began is None:
            self._began = now

    def stop(self) -> None:
        """Stop the elapsed time; later calls have no effect."""
        if self._ended is None:
            self._ended = self.now

    @property
    def elapsed_s(self) -> float:
        """Seconds from the first event to the end of the run, plus those before a resume."""
        began = self.now if self._began is None else self._began
        return self.earlier_s + (self.now if self._ended is None else self._ended) - began


class EventLog:
    """The newest lines of the event log."""

    def __init__(self, clock: RunClock) -> None:
        self._clock = clock
        self.lines: deque[EventLine] = deque(maxlen=EVENTS_KEPT)

    def add(self, text: str) -> LogEvent:
        """Log a line; returns the action that writes it."""
        line = EventLine(elapsed_s=self._clock.elapsed_s, text=text)
        self.lines.append(line)
        return LogEvent(line.elapsed_s, text)
