"""Remembers the code that this user has run on this machine, one file per section ``[environment]``.

The files are in ``$XDG_STATE_HOME/t4nmtd/trusted``, by default ``~/.local/state/t4nmtd/trusted``, named by a digest of
everything in the section that names code and of the module folders' owners. The digest excludes the modules' content,
so users can edit their environment without being asked again.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec

from t4nmtd_dist.core.config import EnvironmentConfig

MOST_ENTRIES = 1000
OTHERS_MAY_WRITE = 0o022


def remember(config: EnvironmentConfig) -> None:
    """Record that this user runs the code named by ``config``; warns if that fails."""
    try:
        folder = _folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _check_private(folder)
        _write(folder / _digest(config), {**_section(config), "utc": datetime.now(UTC).isoformat(timespec="seconds")})
        _forget_oldest(folder)
    except (OSError, RuntimeError) as error:
        text = f"cannot remember that this environment is trusted, so --trust will be needed again: {error}"
        print(f"t4nmtd: warning: {text}", file=sys.stderr)


def is_remembered(config: EnvironmentConfig) -> bool:
    """Whether this user has run this code before; False if the records are unreadable or foreign."""
    try:
        folder = _folder()
        _check_private(folder)
        os.utime(folder / _digest(config))  # least recently used entries are removed first
    except (OSError, RuntimeError):
        return False
    return True


def _folder() -> Path:
    """Folder of the records; the XDG specification ignores relative settings."""
    state = os.environ.get("XDG_STATE_HOME", "")
    return (Path(state) if os.path.isabs(state) else Path.home() / ".local" / "state") / "t4nmtd" / "trusted"


def _check_private(folder: Path) -> None:
    found = folder.stat()
    if found.st_uid != os.geteuid() or found.st_mode & OTHERS_MAY_WRITE:
        raise OSError(f"{folder} must belong to this user, and nobody else may write to it (chmod 700)")


def _digest(config: EnvironmentConfig) -> str:
    told = {**_section(config), "owners": [_owner(folder) for folder in config.folders]}
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def _section(config: EnvironmentConfig) -> dict[str, Any]:
    named = {"id": config.id, "labels": config.labels, "path": config.folders, "options": config.options}
    plain: dict[str, Any] = msgspec.to_builtins(named)
    return plain


def _owner(folder: str) -> int | None:
    """User id of a folder's owner, if it exists."""
    try:
        return os.stat(folder).st_uid
    except (OSError, ValueError):
        return None


def _write(path: Path, entry: dict[str, Any]) -> None:
    """Write a record, atomically for concurrent processes."""
    fresh = path.with_name(f".{path.name}.{os.getpid()}")
    fresh.unlink(missing_ok=True)
    with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
        json.dump(entry, file, indent=1)
    os.replace(fresh, path)


def _forget_oldest(folder: Path) -> None:
    """Limit the number of records, tolerating concurrent processes."""
    dated = []
    for path in folder.iterdir():
        with suppress(FileNotFoundError):
            dated.append((path.stat().st_mtime_ns, path))
    for _, path in sorted(dated)[:-MOST_ENTRIES]:
        path.unlink(missing_ok=True)
