"""One time limit for all long computations from formula to sub-tasks."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

from t4nmtd_dist.core.errors import ConfigError, TranslationError


@dataclass(frozen=True)
class Deadline:
    """The time by which a task must be translated and decomposed.

    Attributes:
        limit: total time allowed, in seconds.
        end: end time, in ``time.monotonic`` seconds.
    """

    limit: float
    end: float

    @classmethod
    def after(cls, limit: float) -> Deadline:
        """The deadline ``limit`` seconds from now.

        Raises:
            ConfigError: if the limit is not a positive number.
        """
        if not (math.isfinite(limit) and limit > 0):
            raise ConfigError(f"time_limit: expected a positive number of seconds, got {limit}")
        return cls(limit, time.monotonic() + limit)

    def left(self) -> float:
        """Seconds left, never negative."""
        return max(0.0, self.end - time.monotonic())

    def check(self, doing: str = "") -> None:
        """Raise if the deadline has passed; ``doing`` names the step after translation.

        Raises:
            TranslationError: during translation.
            ConfigError: in later steps.
        """
        if time.monotonic() > self.end:
            raise self.outgrown(doing) if doing else self.exceeded()

    def exceeded(self) -> TranslationError:
        """The error for a timeout during translation."""
        return TranslationError(
            f"the formula was not translated within {self.limit:g} s: give a higher time limit "
            "(decomposition.time_limit) or a simpler "
            "formula (an automaton can be exponential in its formula: each X nested under F may double it)"
        )

    def outgrown(self, doing: str) -> ConfigError:
        """The error for a timeout after translation, when the automaton is too large."""
        return ConfigError(
            f"the task was not compiled within {self.limit:g} s: its automaton is too large for {doing}. Use fewer "
            "goals (each unordered one doubles the states), declare exclusive groups, set decomposition.prune=false, "
            "or raise decomposition.time_limit"
        )
