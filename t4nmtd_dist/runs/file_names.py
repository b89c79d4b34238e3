"""File names for sub-tasks, whose names may contain ``~`` and ``&``."""

from __future__ import annotations

import hashlib

LONGEST = 200


def file_name(name: str) -> str:
    """The file name for a sub-task's logs, metrics, event files and checkpoints.

    ``~p1`` becomes ``not-p1`` and ``a&b`` becomes ``a+b``; propositions contain neither ``-`` nor ``+``. Names that are
    too long are truncated and get a hash.
    """
    safe = name.replace("~", "not-").replace("&", "+")
    if len(safe) <= LONGEST:
        return safe
    return f"{safe[: LONGEST - 20]}-{hashlib.blake2s(safe.encode(), digest_size=8).hexdigest()}"
