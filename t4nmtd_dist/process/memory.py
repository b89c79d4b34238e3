"""Returns freed memory to the system."""

from __future__ import annotations

import ctypes
import time

EVERY_S = 5.0


def trim_memory() -> None:
    """Return what the C library keeps of freed memory; only glibc can."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


class MemoryTrimmer:
    """Periodically trims the C library's heaps, which otherwise keep the memory of message bursts."""

    def __init__(self) -> None:
        self._due = 0.0

    def turn(self) -> None:
        """Trim if due; takes about a millisecond."""
        now = time.monotonic()
        if now >= self._due:
            self._due = now + EVERY_S
            trim_memory()
