"""Detects a learner loop without progress, for instance in a user's environment."""

from __future__ import annotations

import sys
from collections.abc import Hashable
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Protocol

FIRST_WARNING_S = 60.0  # the interval then doubles
HUNG_S = 600.0  # after which the loop's leases are no longer renewed

_OWN_PACKAGES = ("t4nmtd_dist", "workers")
_ROOT = Path(__file__).resolve().parents[1]


class Loop(Protocol):
    """What other threads may query of a learner loop."""

    def name(self) -> str:
        """Its current work, such as its sub-tasks."""

    def progress(self) -> Hashable:
        """A value that changes with every turn, environment step and update."""

    def where(self) -> str:
        """The call it is in."""


class LoopWatch:
    """Measures how long the learner loop makes no progress; runs in the connection's thread.

    Attributes:
        idle_s: seconds without progress at the last check.
    """

    def __init__(self, loop: Loop, now: float) -> None:
        self._loop = loop
        self._seen: Hashable = None
        self._since, self._stopped_before = now, 0.0
        self._warn_at = FIRST_WARNING_S
        self.idle_s = 0.0

    @property
    def hangs(self) -> bool:
        """Whether the loop counts as hung."""
        return self.idle_s >= HUNG_S

    def check(self, now: float, stopped_s: float) -> str | None:
        """Check the loop; returns a warning if one is due.

        Args:
            now: the clock.
            stopped_s: total seconds in which this process did not run, which do not count.
        """
        seen = self._loop.progress()
        if seen != self._seen:
            self._seen, self._since, self._stopped_before = seen, now, stopped_s
            self._warn_at, self.idle_s = FIRST_WARNING_S, 0.0
            return None
        hung_before = self.hangs
        self.idle_s = now - self._since - (stopped_s - self._stopped_before)
        if self.hangs and not hung_before:
            return f"{self._text()}; its lease is not renewed any more"
        if self.idle_s < self._warn_at:
            return None
        self._warn_at *= 2
        return self._text()

    def _text(self) -> str:
        return f"{self._loop.name()}: no step for {self.idle_s:.0f} s, inside {self._loop.where()}"


def place_of(thread: int) -> str:
    """A thread's position: its last call from our code, and its innermost call.

    Args:
        thread: its identifier, from ``threading.get_ident``.
    """
    frames = _stack(sys._current_frames().get(thread))
    left = [after for before, after in pairwise(frames) if _is_own(before) and not _is_own(after)]
    named = [_name(frame) for frame in (*left[-1:], *frames[-1:])]
    return ", at ".join(dict.fromkeys(named)) or "a thread that has ended"


def _stack(frame: FrameType | None) -> list[FrameType]:
    """A thread's frames, outermost first."""
    found: list[FrameType] = []
    while frame is not None:
        found.append(frame)
        frame = frame.f_back
    return found[::-1]


def _is_own(frame: FrameType) -> bool:
    path = Path(frame.f_code.co_filename)
    return any(path.is_relative_to(_ROOT / package) for package in _OWN_PACKAGES)


def _name(frame: FrameType) -> str:
    code = frame.f_code
    return f"{code.co_qualname} ({Path(code.co_filename).name}:{frame.f_lineno})"
