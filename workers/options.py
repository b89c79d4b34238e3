"""A worker's options; see ``t4nmtd-worker --help``."""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from t4nmtd_dist.core.devices import Device
from t4nmtd_dist.wire.messages import Role


def default_instance() -> str:
    """A default name: host and process id."""
    return f"{socket.gethostname()}:{os.getpid()}"


@dataclass(frozen=True)
class Connection:
    """How to reach the coordinator, and what to trust.

    Attributes:
        coordinator: its control endpoint.
        wait_s: seconds of coordinator silence before giving up.
        keys: folder of this worker's keys; None if the coordinator has none.
        insecure: allow critics beyond loopback without keys.
        trust: import code named by the task, whoever the coordinator is.
    """

    coordinator: str
    wait_s: float = 60.0
    keys: Path | None = None
    insecure: bool = False
    trust: bool = False


@dataclass(frozen=True)
class CriticAddress:
    """Address of this worker's critics.

    Attributes:
        host: address to bind; "" for the one on the route to the coordinator.
        port: 0 for any free one.
        advertise: host advertised to peers, if not ``host``.
    """

    host: str = ""
    port: int = 0
    advertise: str = ""


@dataclass(frozen=True)
class CheckpointOptions:
    """Where and how often a worker writes checkpoints.

    Attributes:
        folder: ``checkpoints/`` of a run directory, or any other folder.
        every_s: checkpoint interval of a learner in seconds.
    """

    folder: Path
    every_s: float = 300.0


@dataclass(frozen=True)
class WorkerOptions:
    """A worker's options.

    Attributes:
        pids: sub-tasks to train, by name or number; empty for the next free ones.
        checkpoints: None to write none.
    """

    connection: Connection
    role: Role = "learner"
    pids: Sequence[str] = ()
    instance: str = field(default_factory=default_instance)
    critic: CriticAddress = CriticAddress()
    checkpoints: CheckpointOptions | None = None
    device: Device = "cpu"
