"""Give freed memory back to the system."""

from __future__ import annotations

import ctypes
import time

EVERY_S = 5.0


class MemoryTrimmer:
    """Trims the C library's heaps now and then; without this, memory that a burst of messages took stays resident.

    Does nothing where the C library has no ``malloc_trim`` (only glibc has it).
    """

    def __init__(self) -> None:
        self._trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        self._due = 0.0

    def turn(self) -> None:
        """Trim if it is due; takes about a millisecond."""
        now = time.monotonic()
        if self._trim is not None and now >= self._due:
            self._due = now + EVERY_S
            self._trim(0)
