"""The signals that ask a process to end."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

END_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # Ctrl-C, kill, and a terminal that is closed


def install_signal_handlers(act: Callable[[int, FrameType | None], object]) -> dict[int, Any]:
    """Call ``act`` at each of these signals, except for those that are ignored, as under ``nohup``.

    Returns:
        The handlers before, by signal.
    """
    before = {number: signal.getsignal(number) for number in END_SIGNALS}
    before = {number: handler for number, handler in before.items() if handler is not signal.SIG_IGN}
    for number in before:
        signal.signal(number, act)
    return {int(number): handler for number, handler in before.items()}


@contextmanager
def noted_signals() -> Iterator[Callable[[], bool]]:
    """Within the block, these signals only set a flag; the function given tells whether one has come."""
    came: list[int] = []
    before = install_signal_handlers(lambda number, _: came.append(number))
    try:
        yield lambda: bool(came)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
