"""Writes checkpoints in a background thread, one at a time."""

from __future__ import annotations

import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.runs.checkpoints import Warn, write_checkpoint


class BackgroundWriter:
    """Writes checkpoints and reports failures: a full disk does not end training.

    Args:
        tell: logs every checkpoint or failure, possibly from another thread.
    """

    def __init__(self, tell: Warn) -> None:
        self._tell = tell
        self._executor = ThreadPoolExecutor(1, "checkpoints")
        self._pending: Future[None] | None = None

    @property
    def busy(self) -> bool:
        """Whether a checkpoint is still being written."""
        return self._pending is not None and not self._pending.done()

    def begin(self, folder: Path, about: Mapping[str, Any], state: Mapping[str, Any]) -> None:
        """Write a checkpoint in the background; its arrays must not change meanwhile."""
        self.wait()
        self._pending = self._executor.submit(self.write, folder, about, state)

    def wait(self) -> None:
        """Wait for the current checkpoint."""
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()

    def write(self, folder: Path, about: Mapping[str, Any], state: Mapping[str, Any]) -> None:
        """Write a checkpoint now."""
        began = time.monotonic()
        try:
            path = write_checkpoint(folder, about, state)
        except RunError as error:
            self._tell(f"{error}; without it a resume goes back to the one before")
            return
        self._tell(f"checkpoint {path} written in {time.monotonic() - began:.2f} s{_size_of(path)}")


def _size_of(checkpoint: Path) -> str:
    """Its size as text; empty if its files are unreadable."""
    try:
        return f", {sum(file.stat().st_size for file in checkpoint.iterdir()) / 1e6:.1f} MB"
    except OSError:
        return ""
