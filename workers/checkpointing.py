"""Writes and restores learner checkpoints."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from t4nmtd_dist.core.errors import PolicyError, RunError
from t4nmtd_dist.core.state_dict import State, copied
from t4nmtd_dist.runs.background import BackgroundWriter
from t4nmtd_dist.runs.checkpoints import Warn, delete_checkpoints, newest_checkpoint
from t4nmtd_dist.runs.resuming import checkpoint_folder, read_identity
from t4nmtd_dist.wire.messages import Granted

if TYPE_CHECKING:
    from workers.learner_session import LearnerSession

UNANSWERED_S = 10.0  # after which a checkpoint is written without the coordinator's answer


@dataclass(frozen=True)
class _Held:
    """A checkpoint held back until the coordinator has counted its content.

    Attributes:
        message: the message that reported all of its content.
        until: when to stop waiting.
    """

    session: LearnerSession
    message: tuple[int, int]
    until: float
    about: State
    state: State


class LearnerCheckpoints:
    """Checkpoints of one worker's learners.

    A resumed learner does not report again what its checkpoint holds. A checkpoint is therefore written only after the
    coordinator has counted its content; otherwise killing the worker could lose those counts.

    Args:
        checkpoints: ``checkpoints/`` of a run directory, with a folder per sub-task; any other folder gets a subfolder
            per run, to keep runs apart.
        every_s: checkpoint interval of a learner in seconds.
        say: logs every checkpoint, possibly from another thread.
    """

    def __init__(self, checkpoints: Path, every_s: float, say: Warn) -> None:
        self._checkpoints, self._every_s, self._say = checkpoints, every_s, say
        self._writer = BackgroundWriter(say)
        self._due: dict[str, float] = {}
        self._held: _Held | None = None

    def resume(self, session: LearnerSession, granted: Granted, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Restore a fresh session from its sub-task's newest checkpoint of this run, if any.

        Raises:
            RunError: if the checkpoint does not fit.
        """
        self._due[session.pid] = time.monotonic() + self._every_s
        wanted = (granted.run_id, granted.pid)
        folder = self._folder(session)
        found = newest_checkpoint(folder, lambda about: (about["run_id"], about["place"]) == wanted, self._say)
        if found is None:
            if session.learner.version:
                self._say(f"{granted.pid}: no checkpoint of it in {folder}; its weights go on, with an empty replay")
            return
        try:
            session.resume_from(found.state, granted, arrays)
        except (RunError, PolicyError, KeyError, TypeError, ValueError) as error:
            raise RunError(f"cannot go on from {found.path}: {error}; delete it to learn without it") from error
        self._say(f"{granted.pid} goes on from {found.path} with {len(session.buffer)} start states")

    def write_due(self, sessions: Collection[LearnerSession]) -> None:
        """Begin to write a due checkpoint.

        Call this right after sending messages to the coordinator, when they cover all work done.
        """
        now = time.monotonic()
        if self._writer.busy:
            return
        if self._held is not None:
            self._write_held(self._held, sessions, now)
            return
        for session in sessions:
            late_s = now - self._due.get(session.pid, now)
            if late_s >= UNANSWERED_S or (late_s >= 0 and session.all_reported):
                self._hold(session, now)
                return

    def _hold(self, session: LearnerSession, now: float) -> None:
        self._due[session.pid] = now + self._every_s
        until = now + UNANSWERED_S if session.all_reported else now
        self._held = _Held(session, session.newest_message, until, _about(session), copied(session.state_dict()))

    def _write_held(self, held: _Held, sessions: Collection[LearnerSession], now: float) -> None:
        """Begin to write the held checkpoint once counted, unless its learner has ended."""
        ended = held.session not in sessions
        if not ended and now < held.until and not held.session.has_answer_to(held.message):
            return
        self._held = None
        if not ended:
            self._writer.begin(self._folder(held.session), held.about, held.state)

    def write_last(self, sessions: Iterable[LearnerSession]) -> None:
        """Write every learner's last checkpoint and wait for it."""
        self._held = None
        self._writer.wait()
        for session in sessions:
            self._writer.write(self._folder(session), _about(session), session.state_dict())

    def delete(self, sessions: Iterable[LearnerSession]) -> None:
        """Delete the learners' checkpoints, once the run is solved."""
        self._writer.wait()
        for session in sessions:
            delete_checkpoints(self._folder(session))
            if not self._is_of_run(session.run_id):
                with suppress(OSError):  # other learners' checkpoints may be there
                    (self._checkpoints / session.run_id).rmdir()

    def _folder(self, session: LearnerSession) -> Path:
        own = self._is_of_run(session.run_id)
        return checkpoint_folder(self._checkpoints if own else self._checkpoints / session.run_id, session.pid)

    def _is_of_run(self, run_id: str) -> bool:
        identity = read_identity(self._checkpoints)
        return identity is not None and identity.run_id == run_id


def _about(session: LearnerSession) -> State:
    learner = session.learner
    return {
        "run_id": session.run_id,
        "place": session.pid,
        "epoch": session.epoch,
        "version": learner.version,
        "interactions": learner.rollout.interactions,
    }
