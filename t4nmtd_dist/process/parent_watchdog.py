"""Ends child processes with their parent, however it ends."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time

CHECK_S = 0.5


def end_with_parent(parent: int) -> None:
    """Send this process SIGTERM once its parent is gone (checked twice a second).

    Args:
        parent: the parent's process id, obtained in the parent, which may exit at any time.
    """
    threading.Thread(target=_watch, args=(parent,), name="parent watchdog", daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(CHECK_S)
    with contextlib.suppress(OSError):  # the reader may be gone too
        print("the process that started this one is gone; ending", file=sys.stderr, flush=True)
    os.kill(os.getpid(), signal.SIGTERM)
