"""The ``serial`` launcher: all roles in lock-step in this process; each ``check`` runs one round."""

from __future__ import annotations

import sys
import time

from coordinator.events import Finish
from coordinator.finishing import retry_pauses, write_result
from coordinator.run_logger import RunLogger
from coordinator.run_settings import RunSettings
from coordinator.snapshot import status
from t4nmtd_dist.launch.build import transferred_weights
from t4nmtd_dist.launch.program import Program
from t4nmtd_dist.launch.protocol import BUDGET_SPENT, SOLVED, STOPPED, Handle, Supervisor
from t4nmtd_dist.launch.serial import SerialRun
from t4nmtd_dist.launch.serial_checkpointing import SerialCheckpoints
from t4nmtd_dist.runs.directory import RunDirectory
from t4nmtd_dist.runs.resuming import write_identity
from t4nmtd_dist.wire.messages import Status

PAUSE_S = 0.1
CODES = {"solved": SOLVED, "budget spent": BUDGET_SPENT}


def start(program: Program, supervisor: Supervisor) -> Handle:
    """Prepare a program to run in this process; see ``Launcher``."""
    return SerialHandle(program, supervisor)


class SerialHandle:
    """A run in this process with its directory, logger and checkpoints.

    Args:
        supervisor: asked whether to stop waiting for disk space.

    Raises:
        RunError: if another process uses the run directory.
    """

    endpoints = None

    def __init__(self, program: Program, supervisor: Supervisor) -> None:
        self._program, self._interrupted = program, supervisor.interrupted
        plan, options = program.plan, program.options
        self._directory = RunDirectory(plan.directory, resume=plan.resumes)
        self._directory.lock()
        settings = RunSettings(
            plan.seed,
            plan.config.max_interactions,
            str(plan.directory),
            lease_s=float("inf"),
            run_id=plan.identity.run_id,
            transfer_from="" if options.transfer_from is None else str(options.transfer_from),
        )
        weights = transferred_weights(program.task, options)
        self._run = SerialRun(program.task, settings, time.monotonic, program.device, weights)
        self._checkpoints = SerialCheckpoints(self._run, self._directory, program.options.checkpoint_every)
        if plan.resumes:
            self._checkpoints.resume()
        write_identity(plan.directory, plan.identity)
        self._recorder = RunLogger(self._run.coordinator, self._directory, program.options.tensorboard, _say)

    def check(self) -> bool:
        """Run one round; False once the run is over."""
        if self._run.coordinator.outcome is not None:
            return False
        self._run.round()
        self._record_notes()
        self._recorder.metrics()
        self._checkpoints.write_due()
        return self._run.coordinator.outcome is None

    def _record_notes(self) -> None:
        for note in self._run.take_notes():
            self._recorder.record(note)

    def status(self, timeout_s: float) -> Status:
        """The run's status after the last round."""
        return status(self._run.coordinator, time.time())

    def interrupt(self) -> None:
        """End the run now."""
        self._run.stop("interrupted")

    def exit_code(self, timeout_s: float) -> int:
        """Write the result, however long it takes; returns the exit code.

        Raises:
            RunError: if the result cannot be written.
        """
        self._record_notes()
        outcome = self._run.coordinator.outcome
        if self._program.plan.resumes and outcome == "solved":
            self._recorder.record(Finish("solved", "the result is written now"))
        pause = retry_pauses(lambda: time.sleep(PAUSE_S), self._interrupted)
        write_result(self._recorder, self._checkpoints, _say, pause)
        return CODES.get(outcome or "", STOPPED)

    def end(self) -> None:
        """Unlock the run directory."""
        self._directory.unlock()

    def failure(self) -> str:
        """Unreachable, because ``exit_code`` returns an outcome or raises."""
        return f"the run in {self._program.directory} ended without an outcome"


def _say(text: str) -> None:
    print(f"t4nmtd: {text}", file=sys.stderr, flush=True)
