"""Checkpoints of a serial run, which resumes bit for bit."""

from __future__ import annotations

import sys
import time

from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.launch.serial import SerialRun
from t4nmtd_dist.runs.background import BackgroundWriter
from t4nmtd_dist.runs.checkpoints import delete_checkpoints, keep_newest_only, newest_checkpoint
from t4nmtd_dist.runs.directory import RunDirectory
from t4nmtd_dist.runs.resuming import SERIAL


class SerialCheckpoints:
    """Writes and restores a serial run's checkpoints.

    Args:
        every_s: checkpoint interval in seconds.
    """

    def __init__(self, run: SerialRun, directory: RunDirectory, every_s: float) -> None:
        self._run, self._directory, self._every_s = run, directory, every_s
        self._folder = directory.checkpoints / SERIAL
        self._writer = BackgroundWriter(self._log)
        self._due = time.monotonic() + every_s

    @property
    def _about(self) -> State:
        return {"run_id": self._run.settings.run_id, "place": SERIAL}

    def _log(self, text: str) -> None:
        self._directory.log_event(self._run.coordinator.elapsed_s, text)

    def resume(self) -> None:
        """Restore the newest checkpoint into a fresh run; later work is repeated.

        The repetition is bit-identical. Without a checkpoint the run starts over, with the same result.
        """
        found = newest_checkpoint(self._folder, lambda about: about == self._about, self._warn)
        if found is not None:
            self._run.load_state_dict(found.state)
        coordinator = self._run.coordinator
        self._directory.mend(coordinator.elapsed_s if found is not None else -1.0)
        source = "the beginning" if found is None else f"checkpoint {found.path.name}"
        self._log(f"resumed after {coordinator.interactions} interactions from {source}")

    @staticmethod
    def _warn(text: str) -> None:
        print(f"t4nmtd: warning: {text}", file=sys.stderr)

    def write_due(self) -> None:
        """Write a checkpoint if one is due; call between rounds."""
        if time.monotonic() >= self._due and self._run.coordinator.outcome is None:
            self._writer.write(self._folder, self._about, self._run.state_dict())
            self._due = time.monotonic() + self._every_s

    def make_room(self) -> None:
        """Delete all but the newest checkpoint."""
        keep_newest_only(self._directory.checkpoints)

    def finish(self, *, written: bool = True) -> None:
        """Write a last checkpoint, or delete all if the run is solved and its result is ``written``."""
        if self._run.coordinator.outcome == "solved" and written:
            delete_checkpoints(self._folder)
        else:
            self._writer.write(self._folder, self._about, self._run.state_dict())
