"""The commands as real processes: start, wait with a deadline that shows what they said, leave none behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sysconfig
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest

from t4nmtd_dist.runs.directory import ENDPOINTS_FILE
from t4nmtd_dist.wire.messages import DashboardState
from t4nmtd_dist.wire.sockets import receive, subscribe
from t4nmtd_dist.wire.zmq_types import new_context

SCRIPTS = Path(sysconfig.get_path("scripts"))
POLL_S = 0.05
START_S = 60.0
LOOPBACK = "tcp://127.0.0.1:*"


@dataclass
class Started:
    """A process whose output goes to files."""

    command: list[str]
    process: subprocess.Popen[bytes]
    out_file: Path
    err_file: Path
    began: float

    @property
    def out(self) -> str:
        return self.out_file.read_text(encoding="utf-8", errors="replace")

    @property
    def err(self) -> str:
        return self.err_file.read_text(encoding="utf-8", errors="replace")

    def story(self) -> str:
        lines = f"--- stdout\n{self.out[-3000:]}\n--- stderr\n{self.err[-3000:]}"
        return f"{' '.join(self.command)}\nexit code {self.process.poll()}\n{lines}"

    def wait(self, seconds: float) -> int:
        """The exit code; the test fails with the output if the process does not end in time."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            pytest.fail(f"still running after {seconds:.0f} s\n{self.story()}")

    def send(self, number: signal.Signals) -> None:
        self.process.send_signal(number)


class Processes:
    """Starts commands of the project and ends, at the latest with the test, all that came of them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.started: list[Started] = []

    def start(self, script: str, *arguments: str, env: Mapping[str, str] | None = None, terminal: int = -1) -> Started:
        """Start a command in a session of its own; ``terminal``: a descriptor in place of the output files."""
        number = len(self.started)
        out, err = self.folder / f"{number}-{script}.out", self.folder / f"{number}-{script}.err"
        command = [str(SCRIPTS / script), *arguments]
        began = time.monotonic()
        with out.open("wb") as out_file, err.open("wb") as err_file:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL if terminal < 0 else terminal,
                stdout=out_file if terminal < 0 else terminal,
                stderr=err_file if terminal < 0 else terminal,
                env={**_plain_environment(), **(env or {})},
                cwd=self.folder,
                start_new_session=True,
            )
        started = Started(command, process, out, err, began)
        self.started.append(started)
        return started

    def coordinator(self, run: Path, *arguments: str, bind: str = LOOPBACK, publish: str = LOOPBACK) -> Started:
        """A coordinator of task7 that listens."""
        options = ["--task", "task7", "--run-dir", str(run), "--bind", bind, "--publish", publish]
        started = self.start("t4nmtd-coordinator", *options, *arguments)
        self.until(lambda: (run / ENDPOINTS_FILE).exists(), "the coordinator listens")
        return started

    def worker(self, run: Path, *arguments: str) -> Started:
        """A worker of the coordinator of ``run``."""
        return self.start("t4nmtd-worker", "--connect", endpoints(run)[0], *arguments)

    def until(self, holds: Callable[[], object], what: str, seconds: float = START_S) -> None:
        """Wait until something holds; the test fails with all output after ``seconds``."""
        deadline = time.monotonic() + seconds
        while not holds():
            if time.monotonic() > deadline:
                stories = "\n\n".join(started.story() for started in self.started)
                pytest.fail(f"not within {seconds:.0f} s: {what}\n{stories}")
            time.sleep(POLL_S)

    def until_state(
        self, run: Path, holds: Callable[[DashboardState], bool], what: str, seconds: float = START_S
    ) -> DashboardState:
        """Wait until the state that the coordinator of ``run`` publishes is as wanted; that state."""
        found: list[DashboardState] = []
        context = new_context()
        socket = subscribe(context, endpoints(run)[1])

        def seen() -> bool:
            envelope = receive(socket, 0.1)
            if envelope is not None and isinstance(envelope.message, DashboardState) and holds(envelope.message):
                found.append(envelope.message)
            return bool(found)

        try:
            self.until(seen, what, seconds)
        finally:
            socket.close(0)
            context.term()
        return found[-1]

    def end(self) -> None:
        """Kill everything that is left, children of killed launchers included."""
        left = [process for started in self.started for process in _family(started.process)]
        left += processes_naming(str(self.folder))
        for process in left:
            try:
                process.kill()
            except psutil.NoSuchProcess:
                continue
        for started in self.started:
            started.process.wait()


def _plain_environment() -> dict[str, str]:
    """The environment without what changes colours or width."""
    hidden = {"NO_COLOR", "CI", "FORCE_COLOR", "COLUMNS", "LINES"}
    return {key: value for key, value in os.environ.items() if key not in hidden}


def _family(process: subprocess.Popen[bytes]) -> list[psutil.Process]:
    if process.poll() is not None:
        return []
    try:
        top = psutil.Process(process.pid)
        return [*top.children(recursive=True), top]
    except psutil.NoSuchProcess:
        return []


def endpoints(run: Path) -> tuple[str, str]:
    """Where the coordinator of a run hears workers, and where it publishes."""
    found = json.loads((run / ENDPOINTS_FILE).read_text(encoding="utf-8"))
    return found["control"], found["state"]


def processes_naming(text: str) -> list[psutil.Process]:
    """Live processes with a command-line argument that contains ``text``."""
    found = []
    for process in psutil.process_iter(["cmdline", "status"]):
        arguments = process.info["cmdline"] or []
        if process.info["status"] != psutil.STATUS_ZOMBIE and any(text in argument for argument in arguments):
            found.append(process)
    return found


def processes_of(run: Path) -> dict[int, list[str]]:
    """Command lines by number of the coordinator and workers of a run, however they were started."""
    found = processes_naming(str(run)) + processes_naming(endpoints(run)[0])
    return {process.pid: process.info["cmdline"] for process in found}


def worker_number(run: Path, instance: str) -> int | None:
    """Process number of the worker of a run that was started with ``--instance``."""
    for number, arguments in processes_of(run).items():
        if "--instance" in arguments and arguments[arguments.index("--instance") + 1] == instance:
            return number
    return None


def events(run: Path) -> list[str]:
    """Texts of a run's event log."""
    path = run / "events.jsonl"
    if not path.exists():
        return []
    return [json.loads(line)["text"] for line in path.read_text(encoding="utf-8").splitlines()]
