"""Whether a compiled task fits into the message that brings it to a worker."""

from __future__ import annotations

import msgpack

from t4nmtd_dist.compiled import CompiledTask
from t4nmtd_dist.errors import ConfigError
from t4nmtd_dist.wire.codec import MAX_HEADER_BYTES

REST_BYTES = 64 << 10  # of the message, beside the task


def check_task_size(task: CompiledTask, most: int = MAX_HEADER_BYTES - REST_BYTES) -> None:
    """Refuse a task that could not be sent to any worker.

    Args:
        task: compiled.
        most: bytes that it may take.

    Raises:
        ConfigError: if it is larger.
    """
    parts = [task.config.to_dict(), task.dfa.to_json(), task.decomposition.to_json(), task.rho.tolist()]
    size = len(msgpack.packb(parts))
    if size > most:
        raise ConfigError(
            f"task {task.config.name!r} has {task.dfa.states} states and {len(task.dfa.edges)} transitions, {size} "
            f"bytes in the message to a worker; at most {most} fit. Use fewer goals, or train with --serial"
        )
