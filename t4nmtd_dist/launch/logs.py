"""The last lines of the processes' logs, to be quoted when one has failed."""

from __future__ import annotations

from pathlib import Path

LINES_QUOTED = 20
LONGEST_LINE = 1000


def tail(log: Path, begin: int = 0) -> str:
    """The last lines of a log, not counting its first ``begin`` bytes; "" if somebody has deleted it."""
    try:
        written = log.read_bytes()[begin:]
    except OSError:
        return ""
    lines = written.decode("utf-8", errors="replace").strip().splitlines()[-LINES_QUOTED:]
    return "\n".join(line if len(line) <= LONGEST_LINE else f"{line[: LONGEST_LINE - 3]}..." for line in lines)


def size(log: Path) -> int:
    """Bytes of a log; 0 if somebody has deleted it."""
    try:
        return log.stat().st_size
    except OSError:
        return 0


def coordinator_failure(log: Path, code: int | None) -> str:
    """Why a coordinator ended without an outcome: its own message if it gave one, else its exit code and log."""
    said = tail(log)
    if said.startswith("t4nmtd-coordinator: "):
        return said.removeprefix("t4nmtd-coordinator: ")
    return f"the coordinator ended with code {code} before the run was over; see {log}\n{said}".rstrip()
