"""One line for the person at the worker's terminal, or in its log."""

from __future__ import annotations

import sys
from contextlib import suppress


def say(text: str) -> None:
    """Write one line; where that is impossible, as on a full disk, go on without."""
    with suppress(OSError):
        print(f"t4nmtd-worker: {text}", file=sys.stderr, flush=True)
