"""How a worker is started; see ``t4nmtd-worker --help``."""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from t4nmtd_dist.core.devices import Device
from t4nmtd_dist.wire.messages import Role


def default_instance() -> str:
    """A name for this process: host and process number."""
    return f"{socket.gethostname()}:{os.getpid()}"


@dataclass(frozen=True)
class Connection:
    """How to reach the coordinator, and what to trust.

    Attributes:
        coordinator: its control endpoint.
        wait_s: seconds without any word from it after which to give up.
        keys: folder of this worker's keys; None where the coordinator has none.
        insecure: allow this worker's critics an address that other machines can reach without keys.
        trust: import the code that the coordinator's task names, whoever the coordinator is.
    """

    coordinator: str
    wait_s: float = 60.0
    keys: Path | None = None
    insecure: bool = False
    trust: bool = False


@dataclass(frozen=True)
class CriticAddress:
    """Where peers reach this worker's critics.

    Attributes:
        host: address to listen on; "" for the one on the way to the coordinator.
        port: 0 for any free one.
        advertise: name or address under which peers find it, if it is another one than ``host``.
    """

    host: str = ""
    port: int = 0
    advertise: str = ""


@dataclass(frozen=True)
class CheckpointOptions:
    """Where and how often a worker writes checkpoints.

    Attributes:
        folder: ``checkpoints/`` of a run directory, or any other folder.
        every_s: seconds between two checkpoints of a learner.
    """

    folder: Path
    every_s: float = 300.0


@dataclass(frozen=True)
class WorkerOptions:
    """How a worker is started.

    Attributes:
        connection: how to reach the coordinator.
        role: learner or evaluator.
        pids: sub-tasks to learn, by name or number; empty for the next free ones.
        instance: name of this worker.
        critic: where peers reach its critics.
        checkpoints: None for no checkpoints.
        device: where it trains.
    """

    connection: Connection
    role: Role = "learner"
    pids: Sequence[str] = ()
    instance: str = field(default_factory=default_instance)
    critic: CriticAddress = CriticAddress()
    checkpoints: CheckpointOptions | None = None
    device: Device = "cpu"
