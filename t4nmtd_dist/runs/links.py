"""Symbolic links inside a run directory: a run neither reads nor writes through them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

from t4nmtd_dist.core.errors import RunError


def refuse_links(folder: Path, is_of_a_run: Callable[[str], bool]) -> None:
    """Refuse a run directory with a symbolic link where a run reads or writes.

    Args:
        folder: the run directory, which may be reached by a link itself.
        is_of_a_run: whether a run uses this name at the top of its directory; other names are left alone.

    Raises:
        RunError: names the first such link.
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
    except FileNotFoundError:  # a checkpoint that was deleted meanwhile
        return []


def open_to_append(path: Path) -> IO[bytes]:
    """Open a file to append to it, unbuffered, and made if need be.

    Raises:
        OSError: if it is a symbolic link, or cannot be opened.
    """
    return open(path, "ab", buffering=0, opener=lambda name, flags: os.open(name, flags | os.O_NOFOLLOW, 0o666))


def open_fresh(path: Path) -> IO[str]:
    """Open a new text file for writing; what had its name, be it a link, is deleted.

    Raises:
        OSError: if it cannot be opened.
    """
    path.unlink(missing_ok=True)
    return path.open("x", encoding="utf-8")
