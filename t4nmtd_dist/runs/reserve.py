"""Room on the disk that a run holds from the beginning, so that its result can be written when the disk is full."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

RESERVE_FILE = ".reserve"


class Reserve:
    """A file of a run directory that holds nothing but room.

    Args:
        run: the run directory.
    """

    def __init__(self, run: Path) -> None:
        self._path = run / RESERVE_FILE
        self._size = 0

    def hold(self, size: int) -> None:
        """Reserve at least this many bytes; where that cannot be done, the run goes on without."""
        if size <= self._size:
            return
        self._size = size
        with suppress(OSError):
            self._path.unlink(missing_ok=True)
            descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            try:
                os.posix_fallocate(descriptor, 0, size)
            except OSError:
                self._path.unlink()
            finally:
                os.close(descriptor)

    def release(self) -> None:
        """Give the room back."""
        with suppress(OSError):
            self._path.unlink(missing_ok=True)
