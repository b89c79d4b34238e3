"""Lines about trouble on the wire, each told once however often it happens."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

QUIET_S = 600.0
MOST_LINES = 100

Tell = Callable[[str], None]


class Notices:
    """Passes a line on unless the same one was passed on in the last ten minutes; usable from any thread.

    Of different lines there are at most 100 in ten minutes: who invents keys cannot fill a disk.

    Args:
        tell: called with a line.
    """

    def __init__(self, tell: Tell) -> None:
        self._tell = tell
        self._told: dict[str, float] = {}
        self._lock = threading.Lock()

    def once(self, text: str) -> None:
        """Tell a line, unless it was told lately."""
        now = time.monotonic()
        with self._lock:
            self._told = {line: at for line, at in self._told.items() if at + QUIET_S > now}
            if text in self._told or len(self._told) >= MOST_LINES:
                return
            self._told[text] = now
        self._tell(text)
