"""Numbers for sub-tasks, such as ``p1`` for the first."""

from __future__ import annotations

import re
from collections.abc import Sequence

LIKE_A_NUMBER = re.compile(r"p[0-9]+")


def numbered(pids: Sequence[str]) -> dict[str, str]:
    """The sub-tasks by number, ``p1``, ``p2``, ..., in the order of ``pids``.

    Empty if any sub-task's name has this form: if ``p1`` is a name, ``p4`` must not be a number.
    """
    if any(LIKE_A_NUMBER.fullmatch(pid) for pid in pids):
        return {}
    return {f"p{number}": pid for number, pid in enumerate(pids, 1)}


def names_with_numbers(pids: Sequence[str]) -> str:
    """All sub-tasks and their numbers, if any, for an error message."""
    numbers = {pid: number for number, pid in numbered(pids).items()}
    return ", ".join(f"{pid} ({numbers[pid]})" if pid in numbers else pid for pid in pids)
