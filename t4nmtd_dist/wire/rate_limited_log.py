"""A log that forwards each line at most once in ten minutes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

QUIET_S = 600.0
MOST_LINES = 100

Log = Callable[[str], None]


class RateLimitedLog:
    """Forwards a line unless it did so in the last ten minutes; thread-safe.

    It forwards at most 100 different lines in ten minutes, so an attacker cannot fill the disk.

    Args:
        log: called with each forwarded line.
    """

    def __init__(self, log: Log) -> None:
        self._pass_on = log
        self._seen: dict[str, float] = {}
        self._lock = threading.Lock()

    def log(self, text: str) -> None:
        """Forward a line unless it was forwarded recently."""
        now = time.monotonic()
        with self._lock:
            self._seen = {line: at for line, at in self._seen.items() if at + QUIET_S > now}
            if text in self._seen or len(self._seen) >= MOST_LINES:
                return
            self._seen[text] = now
        self._pass_on(text)
