"""A log that passes each line on once in ten minutes, however often it is logged."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

QUIET_S = 600.0
MOST_LINES = 100

Log = Callable[[str], None]


class RateLimitedLog:
    """Passes a line on unless the same one was passed on in the last ten minutes; usable from any thread.

    Of different lines there are at most 100 in ten minutes: who invents keys cannot fill a disk.

    Args:
        log: called with each line that is passed on.
    """

    def __init__(self, log: Log) -> None:
        self._pass_on = log
        self._seen: dict[str, float] = {}
        self._lock = threading.Lock()

    def log(self, text: str) -> None:
        """Pass a line on, unless it was passed on lately."""
        now = time.monotonic()
        with self._lock:
            self._seen = {line: at for line, at in self._seen.items() if at + QUIET_S > now}
            if text in self._seen or len(self._seen) >= MOST_LINES:
                return
            self._seen[text] = now
        self._pass_on(text)
