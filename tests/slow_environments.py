"""Environments that take their time: to be opened, or in a step."""

from __future__ import annotations

import threading
import time
from typing import Any

from own_environments import Named

OPENING_S = 0.0
"""What opening one takes; tests raise it."""
GO = threading.Event()
"""Every step of ``Stuck`` waits for it."""
GO.set()


class Slow(Named):
    """Takes ``OPENING_S`` to be opened."""

    def __init__(self) -> None:
        time.sleep(OPENING_S)
        super().__init__()


class Stuck(Named):
    """Its steps can be held up."""

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        GO.wait()
        return super().step(action)
