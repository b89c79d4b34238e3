"""The signals that ask a process to end."""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType

ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # Ctrl-C, kill, and a terminal that is closed


def hear_ends(act: Callable[[int, FrameType | None], object]) -> None:
    """Call ``act`` when one comes; a signal that is ignored stays so, as nohup wants it."""
    for number in ENDS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, act)
