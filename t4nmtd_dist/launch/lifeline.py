"""Child processes that end with the process that started them, however it ends."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time

CHECK_S = 0.5


def end_with_parent() -> None:
    """Send this process SIGTERM as soon as its parent is gone (checked twice a second)."""
    parent = os.getppid()
    threading.Thread(target=_watch, args=(parent,), name="lifeline", daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(CHECK_S)
    print("the process that started this one is gone; ending", file=sys.stderr, flush=True)
    os.kill(os.getpid(), signal.SIGTERM)
