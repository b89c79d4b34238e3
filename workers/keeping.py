"""When what learners hold goes to disk, and how a learner goes on from there."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from t4nmtd_dist.errors import PolicyError, RunError
from t4nmtd_dist.runs.background import BackgroundWriter
from t4nmtd_dist.runs.checkpoints import Warn, delete_checkpoints, newest_checkpoint
from t4nmtd_dist.runs.resuming import checkpoint_folder
from t4nmtd_dist.runs.state_tree import State, copied
from t4nmtd_dist.wire.messages import Granted

if TYPE_CHECKING:
    from workers.learner_session import LearnerSession


class SessionKeeper:
    """Checkpoints of the learners of one worker.

    Args:
        checkpoints: folder that holds a folder for every sub-task.
        every_s: seconds between two checkpoints of a learner.
        say: called with a line about every checkpoint, from another thread, too.
    """

    def __init__(self, checkpoints: Path, every_s: float, say: Warn) -> None:
        self._checkpoints, self._every_s, self._say = checkpoints, every_s, say
        self._writer = BackgroundWriter(say)
        self._due: dict[str, float] = {}

    def go_on(self, session: LearnerSession, granted: Granted, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Let a fresh session go on from the newest checkpoint of its sub-task in this run, if there is one."""
        self._due[session.pid] = time.monotonic() + self._every_s
        wanted = (granted.run_id, granted.pid)
        folder = checkpoint_folder(self._checkpoints, granted.pid)
        found = newest_checkpoint(folder, lambda about: (about["run_id"], about["place"]) == wanted, self._say)
        if found is None:
            return
        try:
            session.go_on_from(found.state, granted, arrays)
        except (RunError, PolicyError, KeyError, TypeError, ValueError) as error:
            raise RunError(f"cannot go on from {found.path}: {error}; delete it to learn without it") from error
        self._say(f"{granted.pid} goes on from {found.path} with {len(session.buffer)} start states")

    def turn(self, sessions: Iterable[LearnerSession]) -> None:
        """Begin to write the checkpoint that is due, if any; the work goes on meanwhile."""
        if self._writer.busy:
            return
        now = time.monotonic()
        for session in sessions:
            if now >= self._due.get(session.pid, now):
                self._due[session.pid] = now + self._every_s
                folder = checkpoint_folder(self._checkpoints, session.pid)
                self._writer.begin(folder, _about(session), copied(session.state()))
                return

    def finish(self, sessions: Iterable[LearnerSession]) -> None:
        """Write the last checkpoint of every learner, and wait for it."""
        self._writer.wait()
        for session in sessions:
            folder = checkpoint_folder(self._checkpoints, session.pid)
            self._writer.write(folder, _about(session), session.state())

    def delete(self, pids: Iterable[str]) -> None:
        """Delete the checkpoints of sub-tasks: a solved run needs them no more."""
        self._writer.wait()
        for pid in pids:
            delete_checkpoints(checkpoint_folder(self._checkpoints, pid))


def _about(session: LearnerSession) -> State:
    learner = session.learner
    return {
        "run_id": session.run_id,
        "place": session.pid,
        "epoch": session.epoch,
        "version": learner.version,
        "interactions": learner.attempts.interactions,
    }
