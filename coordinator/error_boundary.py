"""Logs and survives unexpected exceptions in non-essential parts."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.wire.fields import shortened
from t4nmtd_dist.wire.rate_limited_log import Log, RateLimitedLog


class ErrorBoundary:
    """Logs what failed and where; writes the traceback to stderr.

    It logs the same exception at the same place once in ten minutes.
    """

    def __init__(self, log: Log) -> None:
        self._notices = RateLimitedLog(log)
        self._traced = RateLimitedLog(_write)

    @contextmanager
    def guard(self, what: str) -> Iterator[list[Exception]]:
        """Catch an exception of the block into the yielded list.

        Args:
            what: what the block does, as in "publishing the state".

        Raises:
            RunError: re-raised, because it tells the user what to do.
        """
        caught: list[Exception] = []
        try:
            yield caught
        except RunError:
            raise
        except Exception as error:
            caught.append(error)
            frame = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{Path(frame.filename).name}:{frame.lineno}"
            self._notices.log(shortened(f"unexpected {type(error).__name__} while {what} ({place}): {error}"))
            self._traced.log("".join(traceback.format_exception(error)))


def _write(text: str) -> None:
    with suppress(OSError):
        print(text, file=sys.stderr, flush=True)
