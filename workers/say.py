"""Prints a line to the worker's terminal or log."""

from __future__ import annotations

import sys
from contextlib import suppress


def say(text: str) -> None:
    """Write one line; ignores failures such as a full disk."""
    with suppress(OSError):
        print(f"t4nmtd-worker: {text}", file=sys.stderr, flush=True)
