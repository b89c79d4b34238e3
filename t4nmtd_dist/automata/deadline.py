"""One time limit for all long computations from a formula to its sub-tasks."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

from t4nmtd_dist.core.errors import ConfigError, TranslationError


@dataclass(frozen=True)
class Deadline:
    """A point in time by which a task must be translated and decomposed.

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

    def check(self, doing: str = "") -> None:
        """Do nothing before the deadline.

        Args:
            doing: what is being done, if the formula has already been translated.

        Raises:
            TranslationError: after it, during the translation.
            ConfigError: after it, later.
        """
        if time.monotonic() > self.end:
            raise self.outgrown(doing) if doing else self.exceeded()

    def exceeded(self) -> TranslationError:
        """The error that says that the time is up before there is an automaton."""
        return TranslationError(
            f"the formula was not translated within {self.limit:g} s: give a higher time limit "
            "(decomposition.time_limit) or a simpler "
            "formula (an automaton can be exponential in its formula: each X nested under F may double it)"
        )

    def outgrown(self, doing: str) -> ConfigError:
        """The error that says that the time is up although there is an automaton: it is too large."""
        return ConfigError(
            f"the task was not compiled within {self.limit:g} s: its automaton is too large for {doing}. Use fewer "
            "goals (each unordered one doubles the states), declare exclusive groups, set decomposition.prune=false, "
            "or raise decomposition.time_limit"
        )
