"""A console file that never raises or blocks for long."""

from __future__ import annotations

import io
import os
import select
import time
from typing import IO

FLUSH_WAIT_S = 0.05
MOST_PENDING = 1 << 16
AT_ONCE = 4096  # a pipe that select reports writable takes this much without blocking


class NonBlockingFile(io.TextIOBase):
    """Wraps a console's text file; after a failed write it is ``broken`` and discards everything.

    It reopens a terminal without blocking: one that stops reading (Ctrl-S, a hung connection) leaves text ``pending``.
    Pipes get what they can take. It bypasses Python's buffers, which would report a broken pipe at exit.
    """

    def __init__(self, file: IO[str]) -> None:
        self._file = file
        self._bytes = b""
        self._own = _open_terminal(file)
        self._descriptor = _descriptor(file) if self._own is None else self._own
        self.broken = False

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """The encoding of the wrapped file."""
        return getattr(self._file, "encoding", None) or "utf-8"

    @property
    def pending(self) -> bool:
        """Whether text is waiting for the reader."""
        return bool(self._bytes)

    def isatty(self) -> bool:
        """Whether the wrapped file is a terminal."""
        return self._file.isatty()

    def fileno(self) -> int:
        """The descriptor of the wrapped file."""
        return self._file.fileno()

    def writable(self) -> bool:
        """Always true."""
        return True

    def write(self, text: str) -> int:
        """Queue text; drops it beyond 64 KiB of pending bytes."""
        if not self.broken and len(self._bytes) < MOST_PENDING:
            self._bytes += text.encode(self.encoding, errors="replace")
        return len(text)

    def flush(self) -> None:
        """Write as much as the reader takes within 50 ms."""
        self.drain(FLUSH_WAIT_S)

    def drain(self, wait_s: float) -> None:
        """Write pending text for at most ``wait_s`` seconds."""
        deadline = time.monotonic() + wait_s
        try:
            while self._bytes and not self.broken and self._ready(max(0.0, deadline - time.monotonic())):
                self._push()
        except (OSError, ValueError):
            self.broken = True
            self._bytes = b""

    def release(self) -> None:
        """Close the reopened terminal; the wrapped file stays open."""
        if self._own is not None:
            os.close(self._own)
            self._own = None
        self._bytes = b""
        self.broken = True

    def _ready(self, wait_s: float) -> bool:
        return self._descriptor is None or bool(select.select([], [self._descriptor], [], wait_s)[1])

    def _push(self) -> None:
        if self._descriptor is None:
            text, self._bytes = self._bytes.decode(self.encoding, errors="replace"), b""
            self._file.write(text)
            self._file.flush()
            return
        try:
            self._bytes = self._bytes[os.write(self._descriptor, self._bytes[:AT_ONCE]) :]
        except BlockingIOError:
            return


def _descriptor(file: IO[str]) -> int | None:
    try:
        return file.fileno()
    except (OSError, ValueError, AttributeError):
        return None


def _open_terminal(file: IO[str]) -> int | None:
    """A second, non-blocking descriptor of a file's terminal, or None."""
    try:
        file.flush()
        if not file.isatty():
            return None
        return os.open(os.ttyname(file.fileno()), os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
    except (OSError, ValueError, AttributeError):
        return None
