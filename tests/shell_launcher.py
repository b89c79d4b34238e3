"""A launcher in one file: a shell script starts every role, each writes its process number and exit code to files."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path

from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.launch.command_lines import coordinator_command, worker_command
from t4nmtd_dist.launch.program import Program
from t4nmtd_dist.launch.protocol import Endpoints, Handle, Supervisor
from t4nmtd_dist.runs.directory import ENDPOINTS_FILE

DEADLINE_S = 60.0
ANY_PORTS = ["--bind", "tcp://127.0.0.1:*", "--publish", "tcp://127.0.0.1:*"]


def start(program: Program, supervisor: Supervisor) -> Handle:
    """Start every role as a job of the shell."""
    jobs = ShellJobs(program)
    jobs.submit("coordinator", [*coordinator_command(program), *ANY_PORTS])
    jobs.endpoints = jobs.wait_for_coordinator()
    for role in program.workers:
        jobs.submit(role.name, [*worker_command(program, role, jobs.endpoints.control), "--trust"])
    return jobs


class ShellJobs:
    """Jobs known by the files that they leave behind, as those of a batch system are."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.endpoints: Endpoints | None = None
        self.folder = program.directory / "logs"

    def submit(self, name: str, command: list[str]) -> None:
        job = shlex.quote(str(self.folder / name))
        script = f"({shlex.join(command)} >{job}.log 2>&1; echo $? >{job}.code) & echo $! >{job}.job"
        subprocess.run(["/bin/sh", "-c", script], check=True, start_new_session=True)

    def wait_for_coordinator(self) -> Endpoints:
        file, deadline = self.program.directory / ENDPOINTS_FILE, time.monotonic() + DEADLINE_S
        while not file.exists():
            if self.code("coordinator") is not None or time.monotonic() > deadline:
                raise RunError(self.failure())
            time.sleep(0.05)
        found = json.loads(file.read_text(encoding="utf-8"))
        return Endpoints(found["control"], found["state"])

    def code(self, name: str) -> int | None:
        path = Path(f"{self.folder / name}.code")
        text = path.read_text(encoding="utf-8") if path.exists() else ""
        return int(text) if text else None

    def check(self) -> bool:
        return self.code("coordinator") is None

    def interrupt(self) -> None:
        self.signal("coordinator")

    def signal(self, name: str) -> None:
        """SIGTERM to the processes of one job."""
        job = Path(f"{self.folder / name}.job").read_text(encoding="utf-8").strip()
        found = subprocess.run(["pgrep", "-P", job], capture_output=True, text=True).stdout.split()
        for number in found:
            with suppress(ProcessLookupError):
                os.kill(int(number), signal.SIGTERM)

    def exit_code(self, timeout_s: float) -> int | None:
        deadline = time.monotonic() + timeout_s
        while self.code("coordinator") is None and time.monotonic() < deadline:
            time.sleep(0.05)
        return self.code("coordinator")

    def end(self) -> None:
        names = [role.name for role in self.program.roles]
        deadline = time.monotonic() + DEADLINE_S
        while left := [name for name in names if self.code(name) is None]:
            assert time.monotonic() < deadline, left
            for name in left:
                self.signal(name)
            time.sleep(0.2)

    def failure(self) -> str:
        return (self.folder / "coordinator.log").read_text(encoding="utf-8")
