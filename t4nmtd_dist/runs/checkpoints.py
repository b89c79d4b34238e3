"""Atomic checkpoint folders with damage detection.

``<folder>/<number>/`` holds ``state.json`` (numbers, texts, generator states), ``arrays.safetensors`` and, written
last, ``manifest.json`` with size and SHA-256 of both. All files are written and fsynced under a temporary name that
readers ignore, then renamed.
"""

from __future__ import annotations

import json
import os
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.numpy import load

from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.core.state_dict import State, joined, plain_text, split
from t4nmtd_dist.runs.array_file import array_file_parts

FORMAT = 2
KEPT = 3
MANIFEST_FILE = "manifest.json"
STATE_FILE = "state.json"
ARRAYS_FILE = "arrays.safetensors"
_UNFINISHED = ".new-"

Warn = Callable[[str], None]


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint that was read and verified.

    Attributes:
        about: its metadata (small JSON data).
    """

    path: Path
    about: State
    state: State


class _DamagedError(Exception):
    """A checkpoint that does not match its manifest."""


class _OtherFormatError(Exception):
    """A checkpoint of another program version."""


def write_checkpoint(folder: Path, about: Mapping[str, Any], state: Mapping[str, Any], *, keep: int = KEPT) -> Path:
    """Write a checkpoint, then delete all but the last ``keep``.

    Args:
        folder: of one state's checkpoints; created if needed.
        about: metadata by which a reader chooses.
        state: the state, see ``core.state_dict``.
        keep: how many to keep.

    Raises:
        RunError: if it cannot be written; earlier ones stay.
    """
    try:
        if folder.is_symlink():
            raise OSError("it is a symbolic link, and no checkpoint is written through one")
        folder.mkdir(parents=True, exist_ok=True)
        for left in folder.glob(f"{_UNFINISHED}*"):
            shutil.rmtree(left, ignore_errors=True)
        fresh = folder / f"{_UNFINISHED}{uuid.uuid4().hex}"
        try:
            _write_files(fresh, about, state)
            path = _rename(fresh, folder)
        finally:
            shutil.rmtree(fresh, ignore_errors=True)
        for number in _numbers(folder)[keep:]:
            shutil.rmtree(folder / _name(number), ignore_errors=True)
    except OSError as error:
        raise RunError(f"cannot write a checkpoint to {folder}: {error.strerror or error}") from None
    return path


def _write_files(fresh: Path, about: Mapping[str, Any], state: Mapping[str, Any]) -> None:
    fresh.mkdir()
    plain, arrays = split(state)
    files = {
        STATE_FILE: _write(fresh / STATE_FILE, [plain_text({"about": dict(about), "state": plain}).encode()]),
        ARRAYS_FILE: _write(fresh / ARRAYS_FILE, array_file_parts(arrays)),
    }
    _sync_folder(fresh)
    manifest = json.dumps({"format": FORMAT, "files": files}, indent=1)
    _write(fresh / f".{MANIFEST_FILE}", [manifest.encode()])
    os.replace(fresh / f".{MANIFEST_FILE}", fresh / MANIFEST_FILE)
    _sync_folder(fresh)


def _write(path: Path, parts: Iterator[bytes | memoryview] | list[bytes]) -> dict[str, Any]:
    """Write and fsync a file; returns its manifest entry."""
    digest, size = sha256(), 0
    with path.open("xb") as file:
        for part in parts:
            file.write(part)
            digest.update(part)
            size += len(part)
        file.flush()
        os.fsync(file.fileno())
    return {"size": size, "sha256": digest.hexdigest()}


def _rename(fresh: Path, folder: Path) -> Path:
    """Rename it to the next free number."""
    number = max(_numbers(folder), default=0) + 1
    while True:
        path = folder / _name(number)
        try:
            os.rename(fresh, path)
        except OSError:
            if not path.exists():
                raise
            number += 1
        else:
            _sync_folder(folder)
            return path


def _sync_folder(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _name(number: int) -> str:
    return f"{number:06d}"


def _numbers(folder: Path) -> list[int]:
    """Checkpoint numbers in a folder, newest first."""
    found = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    return sorted((int(name) for name in found if name.isascii() and name.isdigit()), reverse=True)


def newest_checkpoint(folder: Path, fits: Callable[[State], bool], warn: Warn) -> Checkpoint | None:
    """The newest intact checkpoint that fits; None if there is none.

    Args:
        folder: of one state's checkpoints.
        fits: whether a checkpoint with this metadata is wanted; others are skipped silently.
        warn: logs every damaged one.
    """
    if folder.is_symlink():
        warn(f"{folder} is a symbolic link: the checkpoints behind it are not read")
        return None
    for number in _numbers(folder):
        path = folder / _name(number)
        try:
            found = _read(path, fits)
        except _OtherFormatError as error:
            warn(f"checkpoint {path} was written by another version ({error}); going on without it")
            continue
        except (_DamagedError, OSError) as error:
            warn(f"checkpoint {path} is damaged ({error}); going on from the one before it")
            continue
        if found is not None:
            return found
    return None


def _read(path: Path, fits: Callable[[State], bool]) -> Checkpoint | None:
    for part in (path, path / MANIFEST_FILE, path / STATE_FILE, path / ARRAYS_FILE):
        if part.is_symlink():
            raise _DamagedError(f"{part.name} is a symbolic link, which is not followed")
    files = _manifest(path)
    told = json.loads(_checked(path, STATE_FILE, files))
    if not fits(told["about"]):
        return None
    try:
        arrays = load(_checked(path, ARRAYS_FILE, files))
    except SafetensorError as error:
        raise _DamagedError(f"{ARRAYS_FILE}: {error}") from None
    return Checkpoint(path, told["about"], joined(told["state"], arrays))


def _manifest(path: Path) -> dict[str, tuple[int, str]]:
    try:
        manifest = json.loads((path / MANIFEST_FILE).read_bytes())
        if manifest["format"] != FORMAT:
            raise _OtherFormatError(f"format {manifest['format']!r}; this version reads {FORMAT}")
        return {name: (entry["size"], entry["sha256"]) for name, entry in manifest["files"].items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise _DamagedError(f"{MANIFEST_FILE}: {type(error).__name__}") from None


def _checked(path: Path, name: str, files: Mapping[str, tuple[int, str]]) -> bytes:
    """A file's content, verified against the manifest."""
    if name not in files:
        raise _DamagedError(f"{MANIFEST_FILE} does not name {name}")
    size, expected = files[name]
    if (path / name).stat().st_size != size:
        raise _DamagedError(f"{name} has another size than it had")
    data = (path / name).read_bytes()
    if sha256(data).hexdigest() != expected:
        raise _DamagedError(f"{name} has another SHA-256 than it had")
    return data


def keep_newest_only(checkpoints: Path) -> None:
    """Delete all but the newest intact checkpoint in each subfolder."""
    for folder in checkpoints.iterdir() if checkpoints.is_dir() else []:
        newest = newest_checkpoint(folder, lambda about: True, lambda _: None)
        for number in _numbers(folder) if newest is not None and not folder.is_symlink() else []:
            if newest is not None and folder / _name(number) != newest.path:
                shutil.rmtree(folder / _name(number), ignore_errors=True)


def delete_checkpoints(folder: Path) -> None:
    """Delete all checkpoints in a folder, as far as possible."""
    shutil.rmtree(folder, ignore_errors=True)
