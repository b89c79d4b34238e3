"""Quotes the last lines of failed processes' logs."""

from __future__ import annotations

from pathlib import Path

LINES_QUOTED = 20
LONGEST_LINE = 1000


def tail(log: Path, begin: int = 0) -> str:
    """Last lines of a log after its first ``begin`` bytes; "" if it is gone."""
    try:
        written = log.read_bytes()[begin:]
    except OSError:
        return ""
    lines = written.decode("utf-8", errors="replace").strip().splitlines()[-LINES_QUOTED:]
    return "\n".join(line if len(line) <= LONGEST_LINE else f"{line[: LONGEST_LINE - 3]}..." for line in lines)


def size(log: Path) -> int:
    """Size of a log in bytes; 0 if it is gone."""
    try:
        return log.stat().st_size
    except OSError:
        return 0


def coordinator_failure(log: Path, code: int | None) -> str:
    """Why a coordinator ended without an outcome: its message, or exit code and log."""
    said = tail(log)
    if said.startswith("t4nmtd-coordinator: "):
        return said.removeprefix("t4nmtd-coordinator: ")
    return f"the coordinator ended with code {code} before the run was over; see {log}\n{said}".rstrip()
