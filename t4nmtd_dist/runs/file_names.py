"""File names for sub-tasks, whose own names may hold ``~`` and ``&``."""

from __future__ import annotations

import hashlib

LONGEST = 200


def file_name(name: str) -> str:
    """The name that logs, metrics, event files and checkpoints of a sub-task have.

    ``~p1`` becomes ``not-p1`` and ``a&b`` becomes ``a+b``; propositions hold neither ``-`` nor ``+``. A name that
    would be too long for a file is cut and gets a hash of the whole.
    """
    safe = name.replace("~", "not-").replace("&", "+")
    if len(safe) <= LONGEST:
        return safe
    return f"{safe[: LONGEST - 20]}-{hashlib.blake2s(safe.encode(), digest_size=8).hexdigest()}"
