"""The end of a run: write its result, and do not lose a solved one to a full disk."""

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
    """Holds a run's checkpoints."""

    def make_room(self) -> None:
        """Delete what a run whose result is due can do without."""

    def finish(self, *, written: bool) -> None:
        """Write everything a last time; a solved run whose result is ``written`` needs no checkpoints any more."""


def write_result(
    logger: RunLogger, checkpointing: Checkpointing, tell: Callable[[str], None], pause: Callable[[], bool]
) -> None:
    """Write a run's result and last checkpoint; a solved run makes room for it, then waits for room.

    Args:
        logger: of the run, which is over.
        checkpointing: of its checkpoints.
        tell: called with a line about what is waited for.
        pause: waits for a moment; False once there is no use in waiting any longer.

    Raises:
        RunError: if the policy or the summary cannot be written; the newest checkpoint is kept, for a resume. Whatever
            else may be raised on the way is raised after that, too.
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
    """Pauses that have a use for ``WAIT_S`` seconds from the first.

    Args:
        pause: waits for a moment.
        give_up: whether somebody wants to wait no longer.
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
