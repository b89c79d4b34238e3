"""Writes a run's result, and protects a solved one from a full disk."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from coordinator.run_logger import RunLogger
from t4nmtd_dist.core.errors import RunError

WAIT_S = 60.0
PAUSE_S = 1.0
TELL_S = 10.0


class Checkpointing(Protocol):
    """Manages a run's checkpoints."""

    def make_room(self) -> None:
        """Delete what a run does not need to write its result."""

    def finish(self, *, written: bool) -> None:
        """Write a last checkpoint unless the run is solved and its result ``written``."""


def write_result(
    logger: RunLogger, checkpointing: Checkpointing, tell: Callable[[str], None], pause: Callable[[], bool]
) -> None:
    """Write a run's result and last checkpoint; a solved run frees disk space and retries if it must.

    Args:
        logger: of the finished run.
        checkpointing: of its checkpoints.
        tell: logs each wait.
        pause: waits for a moment; False to stop retrying.

    Raises:
        RunError: if the policy or summary cannot be written. The last checkpoint is written first, as before any other
            exception.
    """
    try:
        if not logger.solved:
            logger.close()
        else:
            _write_patiently(logger, checkpointing, tell, pause)
    except Exception:
        checkpointing.finish(written=False)
        raise
    checkpointing.finish(written=True)


def _write_patiently(
    logger: RunLogger, checkpointing: Checkpointing, tell: Callable[[str], None], pause: Callable[[], bool]
) -> None:
    told = -TELL_S
    roomy = False
    while True:
        try:
            logger.close()
            return
        except RunError as error:
            if not roomy:
                checkpointing.make_room()
                roomy = True
                continue
            if time.monotonic() >= told + TELL_S:
                told = time.monotonic()
                tell(f"the run is solved, but {error}; trying again for up to {WAIT_S:.0f} s")
            if not pause():
                raise


def retry_pauses(pause: Callable[[], object], give_up: Callable[[], bool]) -> Callable[[], bool]:
    """Pauses between retries that give up ``WAIT_S`` seconds after the first.

    Args:
        pause: waits for a moment.
        give_up: whether the user wants to stop waiting.
    """
    deadline: list[float] = []

    def paused() -> bool:
        if not deadline:
            deadline.append(time.monotonic() + WAIT_S)
        end = time.monotonic() + PAUSE_S
        while time.monotonic() < end and not give_up():
            pause()
        return time.monotonic() < deadline[0] and not give_up()

    return paused
