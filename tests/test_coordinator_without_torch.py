"""A coordinator and a dashboard need no torch: neither to be imported nor to serve a run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import cast

import pytest
from coordinator_events import weights
from processes import Processes, endpoints

from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import (
    Claim,
    EvaluationJob,
    EvaluationPoll,
    EvaluationReport,
    Granted,
    LearnerStats,
    Message,
    Sync,
    SyncReply,
)
from t4nmtd_dist.wire.sockets import connect, receive, send
from t4nmtd_dist.wire.zmq_types import Context, Socket

pytestmark = pytest.mark.process

DEADLINE_S = 30.0
MODULES = """
import importlib, pkgutil, sys
import coordinator
names = [found.name for found in pkgutil.walk_packages(coordinator.__path__, "coordinator.")]
assert "coordinator.state" in names and "coordinator.ui.dashboard" in names, names
for name in [*names, "t4nmtd_dist.cli.coordinator", "t4nmtd_dist.cli.dashboard"]:
    importlib.import_module(name)
    assert "torch" not in sys.modules, name
"""
SERVING = """
import sys
from pathlib import Path
from t4nmtd_dist.cli.coordinator import CoordinatorCommand, run
from coordinator.service import CoordinatorService

def stop_at_once(service):
    service.interrupt("enough")
    serve(service)

serve, CoordinatorService.serve = CoordinatorService.serve, stop_at_once
command = CoordinatorCommand(
    task="task7", run_dir=Path(sys.argv[1]), bind="tcp://127.0.0.1:*", publish="tcp://127.0.0.1:*"
)
assert run(command) == 130
assert "coordinator.state" in sys.modules
print([name for name in ("torch",) if name in sys.modules])
"""


def python(code: str, *arguments: str) -> str:
    """What a fresh interpreter prints."""
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_no_module_of_the_coordinator_imports_torch() -> None:
    python(MODULES)


def test_a_coordinator_plans_prepares_and_serves_without_torch(tmp_path: Path) -> None:
    assert python(SERVING, str(tmp_path / "run")).splitlines()[-1] == "[]"


def ask(socket: Socket, message: Message, arrays: dict[str, object] | None = None) -> Envelope:
    """The answer to a message."""
    assert socket.poll(int(DEADLINE_S * 1000), 2), "no connection within the deadline"
    assert send(socket, Envelope(message, arrays or {}, "w", 1))  # type: ignore[arg-type]
    answer = receive(socket, DEADLINE_S)
    assert answer is not None, "no answer within the deadline"
    return answer


def test_a_coordinator_checks_weights_and_exports_a_policy_without_torch(
    processes: Processes, context: Context, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    coordinator = processes.coordinator(run, "--set", "evaluation.every=1", "--set", "learner.hidden=[16]")
    socket = connect(context, endpoints(run)[0])
    epoch = cast(Granted, ask(socket, Claim(role="learner", instance="w", pid="g")).message).epoch
    stats = LearnerStats(phase="training", interactions=100)
    sync = Sync(pid="g", epoch=epoch, sequence=1, version=1, start_cursor=0, stats=stats)
    assert isinstance(ask(socket, sync, dict(weights())).message, SyncReply)
    epoch = cast(Granted, ask(socket, Claim(role="evaluator", instance="w")).message).epoch
    job = ask(socket, EvaluationPoll(epoch=epoch)).message
    assert isinstance(job, EvaluationJob)
    assert job.job, "the weights were accepted"
    figures = {"mean_length": 1.0, "std_length": 0.0, "mean_return": 0.0}
    report = EvaluationReport(epoch=epoch, job=job.job, success_rate=0.5, episodes=20, dfa_path=[0], **figures)
    assert send(socket, Envelope(report, {}, "w"))
    processes.until((run / "policy" / "policy.json").exists, "the policy is exported")
    socket.close(0)
    loaded = Path(f"/proc/{coordinator.process.pid}/maps").read_text(encoding="utf-8")
    assert "zmq" in loaded
    assert "torch" not in loaded
