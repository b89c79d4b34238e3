"""``t4nmtd-worker``: trains sub-tasks, or evaluates, for a coordinator."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from t4nmtd_dist.cli.entry import parse
from t4nmtd_dist.core.devices import Device
from t4nmtd_dist.wire.endpoints import DEFAULT_CONTROL


@dataclass(frozen=True)
class WorkerCommand:
    """Learn sub-tasks (or evaluate) for a coordinator, until the run is over."""

    pid: Annotated[list[str], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="PID")] = field(default_factory=list)
    """Sub-task to learn, by name, or by number (p1, p2, ...) where no sub-task has such a name; may be repeated.
    Without it: the next free one."""
    evaluate: bool = False
    """Evaluate the composed policy instead of learning."""
    device: Device = "cpu"
    """Where to train; with networks as small as these the CPU is expected to be faster."""
    connect: str = DEFAULT_CONTROL
    """The coordinator's endpoint."""
    wait: float = 60.0
    """Seconds without any word from the coordinator after which to give up."""
    instance: str = ""
    """Name of this worker; one that claims again under the same name takes its own place over at once."""
    keys: Path | None = None
    """Folder of this worker's keys, one of those made by `t4nmtd keys`; needed where the coordinator has keys."""
    trust: bool = False
    """Import the code that the coordinator's task names, whoever the coordinator is; not needed with --keys."""
    host: str = ""
    """Address on which peers may ask this worker's critics; by default the one on the way to the coordinator."""
    critic_port: int = 0
    """Port for that; by default any free one."""
    advertise: str = ""
    """Name or address under which peers find this worker, if it is another one than --host."""
    insecure: bool = False
    """Allow an address that other machines can reach without keys: on a trusted network only."""
    checkpoints: Path | None = None
    """Folder for checkpoints of what is learned here (networks, optimisers, replay); a worker that takes a sub-task
    goes on from the newest of the same run."""
    checkpoint_every: float = 300.0
    """Seconds between two of them; another is written when this worker ends."""
    parent: int | None = None
    """End when the process of this number, which started this one, has ended (used by `t4nmtd train`)."""


def main() -> None:
    """Entry point of ``t4nmtd-worker``."""
    code = run(parse(WorkerCommand, "t4nmtd-worker", WorkerCommand.__doc__))
    sys.stderr.flush()
    os._exit(code)  # avoids seconds of waiting for unfinished imports and torch's clean-up


def run(command: WorkerCommand) -> int:
    """Run a worker; returns the exit code."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported
    from t4nmtd_dist.core.devices import check_device
    from t4nmtd_dist.core.errors import BROKEN_ENVIRONMENT, ConfigError, EnvError, T4NMTDError
    from t4nmtd_dist.process.parent_watchdog import end_with_parent
    from t4nmtd_dist.wire.endpoints import check_endpoint

    if command.parent is not None:
        end_with_parent(command.parent)
    try:
        check_endpoint(command.connect)
        if command.evaluate and command.pid:
            print("t4nmtd-worker: --evaluate learns nothing, so it takes no --pid", file=sys.stderr)
            return 2
        if command.evaluate and command.device != "cpu":
            print("t4nmtd-worker: --evaluate plays on the CPU, so it takes no --device", file=sys.stderr)
            return 2
        check_device(command.device)
        if not command.checkpoint_every > 0:
            raise ConfigError(f"--checkpoint-every {command.checkpoint_every}: expected seconds above 0")
        return _work(command)
    except T4NMTDError as error:
        print(f"t4nmtd-worker: {error}", file=sys.stderr)
        return BROKEN_ENVIRONMENT if isinstance(error, EnvError) else 2
    except KeyboardInterrupt:
        return 130


def _work(command: WorkerCommand) -> int:
    from workers.options import CheckpointOptions, Connection, CriticAddress, WorkerOptions, default_instance
    from workers.worker import Worker

    kept = None if command.checkpoints is None else CheckpointOptions(command.checkpoints, command.checkpoint_every)
    options = WorkerOptions(
        Connection(command.connect, command.wait, command.keys, command.insecure, command.trust),
        role="evaluator" if command.evaluate else "learner",
        pids=tuple(command.pid),
        instance=command.instance or default_instance(),
        critic=CriticAddress(command.host, command.critic_port, command.advertise),
        checkpoints=kept,
        device=command.device,
    )
    return Worker(options).run()


if __name__ == "__main__":
    main()
