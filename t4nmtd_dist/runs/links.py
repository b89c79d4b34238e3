"""Symbolic links inside a run directory, which a run never follows."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

from t4nmtd_dist.core.errors import RunError


def refuse_links(folder: Path, is_of_a_run: Callable[[str], bool]) -> None:
    """Reject a run directory with a symbolic link where a run reads or writes.

    Args:
        folder: the run directory, which may itself be a link.
        is_of_a_run: whether a run uses this top-level name; other names are ignored.

    Raises:
        RunError: with the first such link.
    """
    for entry in _entries(folder):
        if is_of_a_run(entry.name):
            for link in _links(entry):
                raise RunError(
                    f"{link} is a symbolic link, and a run follows none inside its directory; put what it points to "
                    "in its place, or delete it"
                )


def _links(entry: os.DirEntry[str]) -> Iterator[str]:
    if entry.is_symlink():
        yield entry.path
    elif entry.is_dir(follow_symlinks=False):
        for inner in _entries(entry.path):
            yield from _links(inner)


def _entries(folder: Path | str) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as found:
            return sorted(found, key=lambda entry: entry.name)
    except FileNotFoundError:  # a checkpoint deleted meanwhile
        return []


def open_to_append(path: Path) -> IO[bytes]:
    """Open a file for unbuffered appending, creating it if needed.

    Raises:
        OSError: if it is a symbolic link, or cannot be opened.
    """
    return open(path, "ab", buffering=0, opener=lambda name, flags: os.open(name, flags | os.O_NOFOLLOW, 0o666))


def open_fresh(path: Path) -> IO[str]:
    """Open a new text file for writing, replacing any file or link of that name.

    Raises:
        OSError: if it cannot be opened.
    """
    path.unlink(missing_ok=True)
    return path.open("x", encoding="utf-8")
