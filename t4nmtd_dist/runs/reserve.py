"""Reserves disk space so that the result can be written on a full disk."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

RESERVE_FILE = ".reserve"


class Reserve:
    """A placeholder file in a run directory."""

    def __init__(self, run: Path) -> None:
        self._path = run / RESERVE_FILE
        self._size = 0

    def hold(self, size: int) -> None:
        """Reserve at least this many bytes, if possible."""
        if size <= self._size:
            return
        with suppress(OSError):
            self._path.unlink(missing_ok=True)
            self._size = 0
            descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            try:
                os.posix_fallocate(descriptor, 0, size)
                self._size = size
            except OSError:
                self._path.unlink()
            finally:
                os.close(descriptor)

    def release(self) -> None:
        """Free the space."""
        with suppress(OSError):
            self._path.unlink(missing_ok=True)
