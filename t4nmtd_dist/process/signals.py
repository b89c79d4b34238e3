"""Handles the signals that ask a process to end."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

END_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # Ctrl-C, kill, closed terminal


def install_signal_handlers(act: Callable[[int, FrameType | None], object]) -> dict[int, Any]:
    """Call ``act`` on each of these signals, except ignored ones (``nohup``).

    Returns:
        The previous handlers by signal.
    """
    before = {number: signal.getsignal(number) for number in END_SIGNALS}
    before = {number: handler for number, handler in before.items() if handler is not signal.SIG_IGN}
    for number in before:
        signal.signal(number, act)
    return {int(number): handler for number, handler in before.items()}


@contextmanager
def noted_signals() -> Iterator[Callable[[], bool]]:
    """Let these signals only set a flag within the block; yields a function that returns it."""
    came: list[int] = []
    before = install_signal_handlers(lambda number, _: came.append(number))
    try:
        yield lambda: bool(came)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
