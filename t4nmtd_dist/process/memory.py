"""Returns freed memory to the system."""

from __future__ import annotations

import ctypes
import time

EVERY_S = 5.0


class MemoryTrimmer:
    """Periodically trims the C library's heaps, which otherwise keep the memory of message bursts.

    Only glibc has ``malloc_trim``; elsewhere it does nothing.
    """

    def __init__(self) -> None:
        self._trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        self._due = 0.0

    def turn(self) -> None:
        """Trim if due; takes about a millisecond."""
        now = time.monotonic()
        if self._trim is not None and now >= self._due:
            self._due = now + EVERY_S
            self._trim(0)
