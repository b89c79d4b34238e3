"""Checks that a task and its weights fit into the protocol's messages."""

from __future__ import annotations

import math

import msgpack

from t4nmtd_dist.agents.weight_checks import NetworkSizes, expected_shapes
from t4nmtd_dist.agents.weights import acting_part
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.wire.codec import MAX_ARRAY_BYTES, MAX_ARRAYS, MAX_HEADER_BYTES, MAX_MESSAGE_BYTES

REST_BYTES = 64 << 10  # of the message, without the task
SMALLEST = NetworkSizes(observation=1, action=1)  # a task does not state these sizes
NUMBER_BYTES = 4  # float32


def check_task_size(task: CompiledTask, most: int = MAX_HEADER_BYTES - REST_BYTES) -> None:
    """Reject a task that is too large for the messages that carry it or its weights.

    Args:
        task: compiled.
        most: maximum size of the task in bytes.

    Raises:
        ConfigError: if the task or its networks are too large.
    """
    _check_networks(task)
    parts = [task.config.to_dict(), task.dfa.to_json(), task.decomposition.to_json(), task.rho.tolist()]
    size = len(msgpack.packb(parts))
    if size > most:
        raise ConfigError(
            f"task {task.config.name!r} has {task.dfa.states} states and {len(task.dfa.edges)} transitions, {size} "
            f"bytes in the message to a worker; at most {most} fit. Use fewer goals, or train with --serial"
        )


def _check_networks(task: CompiledTask) -> None:
    """Reject networks too large for any observations and actions."""
    shapes = expected_shapes(task.config, task.dfa.states, SMALLEST)
    sizes = {name: NUMBER_BYTES * math.prod(shape) for name, shape in shapes.items()}
    acting = [size for name, size in sizes.items() if name.startswith(f"{acting_part(sizes)}.")]
    pids = len(task.decomposition.pids)
    _refuse(task, max(sizes.values()) / 2**20, MAX_ARRAY_BYTES / 2**20, "MiB in one array")
    _refuse(task, len(sizes), MAX_ARRAYS, "arrays in the message of a learner")
    _refuse(task, sum(sizes.values()) / 2**20, MAX_MESSAGE_BYTES / 2**20, "MiB in the message of a learner")
    _refuse(task, pids * len(acting), MAX_ARRAYS, "arrays in the message to an evaluator")
    _refuse(task, pids * sum(acting) / 2**20, MAX_MESSAGE_BYTES / 2**20, "MiB in the message to an evaluator")


def _refuse(task: CompiledTask, amount: float, most: float, what: str) -> None:
    if amount > most:
        raise ConfigError(
            f"task {task.config.name!r} has {len(task.decomposition.pids)} sub-tasks, and learner.hidden = "
            f"{list(task.config.learner.hidden)}: the weights come to {amount:.4g} {what}; at most {most:.4g} fit. "
            f"Use smaller or fewer hidden layers or fewer sub-tasks, or train with --serial"
        )
