"""Shell commands that start a coordinator's workers on its machine."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from coordinator.numbering import numbered
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.wire.addresses import EVERYWHERE, LOOPBACK, address_towards, split_endpoint
from t4nmtd_dist.wire.endpoints import DEFAULT_CONTROL

ELSEWHERE = "tcp://192.0.2.1:9"  # a documentation address (RFC 5737), to look up the route; nothing is sent


class WorkerCommands:
    """Command lines of workers.

    Args:
        pids: the sub-tasks.
        control: the coordinator's control endpoint.
        keys: the coordinator's key folder, which local workers can use too.
    """

    def __init__(self, pids: Sequence[str], control: str, keys: Path | None = None) -> None:
        self._numbers = {pid: number for number, pid in numbered(pids).items()}
        self._pids = tuple(pids)
        connect = _reachable(control)
        self._where = [] if connect == DEFAULT_CONTROL else ["--connect", connect]
        self._where += [] if keys is None else ["--keys", str(keys.absolute())]

    def learner(self, pid: str) -> str:
        """The command for a sub-task, by number if it has one."""
        return shlex.join(["t4nmtd-worker", "--pid", self._numbers.get(pid, pid), *self._where])

    def evaluator(self) -> str:
        """The command for an evaluator."""
        return shlex.join(["t4nmtd-worker", "--evaluate", *self._where])

    def welcome(self, task: str) -> str:
        """The coordinator's first message: the workers to start."""
        commands = [self.learner(pid) for pid in self._pids]
        width = max(len(command) for command in commands)
        lines = [f"  {command:<{width}}  # {pid}" for command, pid in zip(commands, self._pids, strict=True)]
        count = (
            "1 sub-task; start its worker" if len(lines) == 1 else f"{len(lines)} sub-tasks; start a worker for each"
        )
        return "\n".join([f"{task} has {count}, in any order, each in a terminal of its own:", *lines])


def _reachable(control: str) -> str:
    """An endpoint for workers on other machines."""
    host, port = split_endpoint(control)
    if host not in EVERYWHERE:
        return control
    try:
        return f"tcp://{address_towards(ELSEWHERE)}:{port}"
    except ConfigError:
        return f"tcp://{LOOPBACK}:{port}"
