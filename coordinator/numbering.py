"""Numbers for sub-tasks: ``p1`` is the first of a task whose sub-tasks have other names."""

from __future__ import annotations

import re
from collections.abc import Sequence

LIKE_A_NUMBER = re.compile(r"p[0-9]+")


def numbered(pids: Sequence[str]) -> dict[str, str]:
    """The sub-task behind each of ``p1``, ``p2``, ..., in the order of ``pids``.

    Empty if any sub-task has a name of this form: where ``p1`` is a name, ``p4`` must not be a number.
    """
    if any(LIKE_A_NUMBER.fullmatch(pid) for pid in pids):
        return {}
    return {f"p{number}": pid for number, pid in enumerate(pids, 1)}


def names_with_numbers(pids: Sequence[str]) -> str:
    """All sub-tasks for an error message, each with its number if it has one."""
    numbers = {pid: number for number, pid in numbered(pids).items()}
    return ", ".join(f"{pid} ({numbers[pid]})" if pid in numbers else pid for pid in pids)
