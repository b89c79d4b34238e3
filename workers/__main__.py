"""``t4nmtd-worker``: learns one or more sub-tasks, or evaluates, for a coordinator."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, field
from typing import Annotated

import tyro

from t4nmtd_dist.wire.endpoints import DEFAULT_CONTROL


@dataclass(frozen=True)
class WorkerCommand:
    """Learn sub-tasks (or evaluate) for a coordinator, until the run is over."""

    pid: Annotated[list[str], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="PID")] = field(default_factory=list)
    """Sub-task to learn, such as p1; may be repeated. Without it: the next free one."""
    evaluate: bool = False
    """Evaluate the composed policy instead of learning."""
    connect: str = DEFAULT_CONTROL
    """The coordinator's endpoint."""
    wait: float = 60.0
    """Seconds without any word from the coordinator after which to give up."""
    instance: str = ""
    """Name of this worker; one that claims again under the same name takes its own place over at once."""
    host: str = "127.0.0.1"
    """Address on which peers may ask this worker's critics."""
    insecure: bool = False
    """Allow --host to be an address that other machines can reach."""
    lifeline: int | None = None
    """End when the process of this number, which started this one, has ended (used by `t4nmtd train`)."""


def main() -> None:
    """Entry point of ``t4nmtd-worker``."""
    code = run(tyro.cli(WorkerCommand, prog="t4nmtd-worker"))
    sys.stderr.flush()
    os._exit(code)  # Python would wait for an unfinished import, and then for torch to tidy up: seconds


def run(command: WorkerCommand) -> int:
    """Run a worker; the exit code."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported
    from t4nmtd_dist.errors import T4NMTDError
    from t4nmtd_dist.launch.lifeline import end_with_parent
    from t4nmtd_dist.wire.endpoints import check_endpoint

    if command.lifeline is not None:
        end_with_parent(command.lifeline)
    try:
        check_endpoint(command.connect)
        if command.evaluate and command.pid:
            print("t4nmtd-worker: --evaluate learns nothing, so it takes no --pid", file=sys.stderr)
            return 2
        return _work(command)
    except T4NMTDError as error:
        print(f"t4nmtd-worker: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


def _work(command: WorkerCommand) -> int:
    from workers.worker import Worker, WorkerOptions, default_instance

    options = WorkerOptions(
        coordinator=command.connect,
        role="evaluator" if command.evaluate else "learner",
        pids=tuple(command.pid),
        instance=command.instance or default_instance(),
        wait_s=command.wait,
        critic_host=command.host,
        insecure=command.insecure,
    )
    return Worker(options).run()


if __name__ == "__main__":
    main()
