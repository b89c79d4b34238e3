"""The ``local`` launcher: every role is a process on this machine."""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Protocol

from t4nmtd_dist.core.errors import ProtocolError, RunError
from t4nmtd_dist.launch.command_lines import coordinator_command, worker_command
from t4nmtd_dist.launch.logs import coordinator_failure
from t4nmtd_dist.launch.program import Program, Role
from t4nmtd_dist.launch.protocol import Endpoints, Handle, Supervisor
from t4nmtd_dist.launch.restarts import Process, RestartedWorkers
from t4nmtd_dist.runs.directory import ENDPOINTS_FILE
from t4nmtd_dist.runs.links import open_to_append
from t4nmtd_dist.wire.auth.keys import load_client
from t4nmtd_dist.wire.messages import Status
from t4nmtd_dist.wire.status_client import ask_status
from t4nmtd_dist.wire.zmq_types import new_context

START_DEADLINE_S = 60.0
END_DEADLINE_S = 20.0  # time in which workers write their last checkpoints; most need a second
POLL_S = 0.02
LOOPBACK = "tcp://127.0.0.1:*"


class Spawn(Protocol):
    """Starts a role as a process on this machine."""

    def __call__(self, program: Program, role: Role, control: str) -> Process:
        """Start it; its output goes to ``program.log(role)``, and it ends with this process.

        Args:
            program: the program.
            role: one of its roles.
            control: the coordinator's endpoint; "" for the coordinator itself, which chooses free loopback ports.
        """


def start(program: Program, supervisor: Supervisor) -> Handle:
    """Start a program as processes of this machine; see ``Launcher``."""
    return start_processes(program, supervisor, spawn_command)


def start_processes(program: Program, supervisor: Supervisor, spawn: Spawn) -> Handle:
    """Start the coordinator, and the workers once it listens.

    Args:
        program: the program.
        supervisor: notified of dead workers.
        spawn: starts one role.

    Raises:
        RunError: with the coordinator's own message if it exits or does not listen in time.
    """
    handle = LocalProcesses(program, supervisor, spawn)
    try:
        handle.start()
    except BaseException:
        handle.end()
        raise
    return handle


def spawn_command(program: Program, role: Role, control: str) -> Process:
    """Start a role by its command line, in its own session, out of reach of Ctrl-C."""
    if role.kind == "coordinator":
        command = [*coordinator_command(program), "--bind", LOOPBACK, "--publish", LOOPBACK]
    else:
        command = [*worker_command(program, role, control), "--trust"]  # the coordinator is our own
    return spawn_logged([*command, "--parent", str(os.getpid())], program.log(role), role.environment)


def spawn_logged(command: list[str], log: Path, environment: Mapping[str, str]) -> Process:
    """Start a command and append its output to a log."""
    with open_to_append(log) as file:
        return subprocess.Popen(
            command, stdout=file, stderr=file, env={**os.environ, **environment}, start_new_session=True
        )


class LocalProcesses:
    """The processes of one program; restarts dead workers, but a dead coordinator ends the run.

    Args:
        supervisor: notified of dead workers.
    """

    def __init__(self, program: Program, supervisor: Supervisor, spawn: Spawn) -> None:
        self._program, self._report, self._spawn = program, supervisor.report, spawn
        self._coordinator: Process | None = None
        self.endpoints: Endpoints | None = None
        self.workers = RestartedWorkers(supervisor.report)

    def start(self) -> None:
        """Start everything; raises as ``start_processes``."""
        file = self._program.directory / ENDPOINTS_FILE
        file.unlink(missing_ok=True)
        self._coordinator = self._spawn(self._program, self._program.coordinator, "")
        found = self._wait_for_endpoints(file, self._coordinator)
        self.endpoints = found
        for role in self._program.workers:
            spawned = partial(self._spawn, self._program, role, found.control)
            self.workers.add(role.name, spawned, self._program.log(role), learns=role.kind == "learner")

    def _wait_for_endpoints(self, file: Path, coordinator: Process) -> Endpoints:
        deadline = time.monotonic() + START_DEADLINE_S
        while not file.exists():
            if coordinator.poll() is not None:
                raise RunError(self.failure())
            if time.monotonic() > deadline:
                raise RunError(f"the coordinator did not listen within {START_DEADLINE_S:.0f} s")
            time.sleep(POLL_S)
        found = json.loads(file.read_text(encoding="utf-8"))
        return Endpoints(found["control"], found["state"])

    def check(self) -> bool:
        """Restart dead workers; False once the coordinator has ended.

        Raises:
            RunError: with the end of a log if no learner is left.
        """
        if self._coordinator is None or self._coordinator.poll() is not None:
            return False
        self.workers.check()
        return True

    def status(self, timeout_s: float) -> Status | None:
        """The coordinator's status; None if it does not answer in time."""
        if self.endpoints is None:
            return None
        keys = None if self._program.keys is None else load_client(self._program.keys)
        context = new_context()
        try:
            return ask_status(context, self.endpoints.control, keys, timeout_s)
        except (RunError, ProtocolError):
            return None
        finally:
            context.term()

    def interrupt(self) -> None:
        """Ask the coordinator to end the run."""
        if self._coordinator is not None and self._coordinator.poll() is None:
            self._coordinator.terminate()

    def exit_code(self, timeout_s: float) -> int | None:
        """The coordinator's exit code; None if it does not end within ``timeout_s`` seconds."""
        if self._coordinator is None:
            return None
        try:
            return self._coordinator.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def failure(self) -> str:
        """Why the coordinator ended without an outcome."""
        code = None if self._coordinator is None else self._coordinator.returncode
        return coordinator_failure(self._program.log(self._program.coordinator), code)

    def end(self) -> None:
        """Terminate remaining processes, and wait for their last checkpoints."""
        running = {f"worker {name}": worker.process for name, worker in self.workers.workers.items()}
        running |= {"the coordinator": self._coordinator} if self._coordinator is not None else {}
        end_processes(running, self._report)


def end_processes(running: Mapping[str, Process], report: Callable[[str, bool], None]) -> None:
    """Terminate processes, and kill those that do not end in time.

    Args:
        running: by name.
        report: called for each killed process.
    """
    for process in running.values():
        if process.poll() is None:
            process.terminate()
    deadline = time.monotonic() + END_DEADLINE_S
    for name, process in running.items():
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            late = f"{name} did not end within {END_DEADLINE_S:.0f} s and was killed"
            report(f"{late}; its newest checkpoint may be older than what was counted", True)
