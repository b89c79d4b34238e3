"""Persists the coordinator's state: counts every second, checkpoints at longer intervals and at the end."""

from __future__ import annotations

import time
from pathlib import Path

from coordinator.best_policy import consider_exported
from coordinator.saved_state import load_saved_state, raise_counts, saved_counts, saved_state
from coordinator.state import CoordinatorState
from t4nmtd_dist.agents.weights import acting_parameters
from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.runs.background import BackgroundWriter
from t4nmtd_dist.runs.checkpoints import Warn, delete_checkpoints, keep_newest_only, newest_checkpoint
from t4nmtd_dist.runs.counts import COUNTS_FILE, counts_of_summary, read_counts, write_counts
from t4nmtd_dist.runs.directory import SUMMARY_FILE, read_summary
from t4nmtd_dist.runs.reserve import Reserve
from t4nmtd_dist.runs.resuming import COORDINATOR

COUNTS_EVERY_S = 1.0
TROUBLE_S = 60.0
RESULT_OVERHEAD = 2**20  # bytes of a result besides the actors' weights


class StateCheckpointing:
    """Writes what a resumed run needs of the coordinator.

    Args:
        checkpoints: the run's checkpoint folder.
        every_s: checkpoint interval in seconds.
        tell: logs every checkpoint, possibly from another thread.
    """

    def __init__(self, state: CoordinatorState, checkpoints: Path, every_s: float, tell: Warn) -> None:
        self._state, self._checkpoints, self._every_s = state, checkpoints, every_s
        self._tell = tell
        self._writer = BackgroundWriter(tell)
        self._reserve = Reserve(checkpoints.parent)
        self._counts_due = 0.0
        self._due = time.monotonic() + every_s

    @property
    def _about(self) -> State:
        return {"run_id": self._state.settings.run_id, "place": COORDINATOR}

    def turn(self) -> None:
        """Write what is due."""
        now = time.monotonic()
        if now >= self._counts_due:
            self._counts_due = now + (COUNTS_EVERY_S if self._write_counts() else TROUBLE_S)
            self._reserve.hold(result_size(self._state))
        if now >= self._due and not self._writer.busy:
            self._due = now + self._every_s
            self._writer.begin(self._checkpoints / COORDINATOR, self._about, saved_state(self._state))

    def _write_counts(self) -> bool:
        try:
            write_counts(self._checkpoints, self._about | saved_counts(self._state))
        except OSError as error:
            self._tell(f"cannot write counts to {self._checkpoints}: {error.strerror}")
            return False
        return True

    def make_room(self) -> None:
        """Release the reserve, and delete all but each process's newest checkpoint."""
        self._writer.wait()
        self._reserve.release()
        keep_newest_only(self._checkpoints)

    def finish(self, *, written: bool = True) -> None:
        """Write a last checkpoint, or delete all if the run is solved and its result is ``written``."""
        self._writer.wait()
        self._reserve.release()
        self._write_counts()
        if self._state.outcome == "solved" and written:
            delete_checkpoints(self._checkpoints / COORDINATOR)
        else:
            self._writer.write(self._checkpoints / COORDINATOR, self._about, saved_state(self._state))


def result_size(state: CoordinatorState) -> int:
    """Approximate size of a run's result in bytes; 0 without a policy."""
    weights = [acting_parameters(record.weights) for record in state.records.values() if record.version]
    size = sum(int(array.nbytes) for named in weights for array in named.values())
    return size + RESULT_OVERHEAD if weights else 0


def resume_state(state: CoordinatorState, checkpoints: Path, warn: Warn) -> str:
    """Restore a stopped run into a fresh coordinator; returns a line naming the source.

    Args:
        state: of the same task, seed and run.
        checkpoints: the run's checkpoint folder.
        warn: logs damaged checkpoints or a damaged policy.
    """
    about = {"run_id": state.settings.run_id, "place": COORDINATOR}
    found = newest_checkpoint(checkpoints / COORDINATOR, lambda told: told == about, warn)
    if found is not None:
        load_saved_state(state, found.state)
    counts, source = read_counts(checkpoints, warn), COUNTS_FILE
    if counts is None and found is None:
        counts, source = _counts_of_summary(checkpoints.parent, state.settings.run_id), SUMMARY_FILE
    spent = counts is not None and counts["run_id"] == state.settings.run_id
    if counts is not None and spent:
        raise_counts(state, counts)
    consider_exported(state, checkpoints.parent / "policy", warn)
    if found is not None:
        return f"resumed after {state.interactions} interactions from checkpoint {found.path.name}"
    known = f"{source} has what was spent" if spent else "what was spent is not known"
    return f"resumed after {state.interactions} interactions from no checkpoint: {known}; Q and evaluations begin anew"


def _counts_of_summary(run: Path, run_id: str) -> State | None:
    try:
        return counts_of_summary(read_summary(run), run_id)
    except RunError:  # missing or damaged
        return None
