"""A time limit that every long computation of a translation keeps."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

from t4nmtd_dist.errors import ConfigError, TranslationError


@dataclass(frozen=True)
class Deadline:
    """A point in time by which a translation must be done.

    Attributes:
        limit: the whole time allowed, in seconds.
        end: the point in time, on the clock of ``time.monotonic``.
    """

    limit: float
    end: float

    @classmethod
    def after(cls, limit: float) -> Deadline:
        """The deadline that lies ``limit`` seconds ahead.

        Raises:
            ConfigError: if the limit is not a positive number.
        """
        if not (math.isfinite(limit) and limit > 0):
            raise ConfigError(f"time_limit: expected a positive number of seconds, got {limit}")
        return cls(limit, time.monotonic() + limit)

    def left(self) -> float:
        """Seconds that are left, never negative."""
        return max(0.0, self.end - time.monotonic())

    def check(self) -> None:
        """Do nothing before the deadline.

        Raises:
            TranslationError: after it.
        """
        if time.monotonic() > self.end:
            raise self.exceeded()

    def exceeded(self) -> TranslationError:
        """The error that says that the time is up."""
        return TranslationError(
            f"the formula was not translated within {self.limit:g} s: give a higher time limit or a simpler "
            "formula (an automaton can be exponential in its formula: each X nested under F may double it)"
        )
