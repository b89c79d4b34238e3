"""The allow list of client keys in a running program."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from pathlib import Path

from t4nmtd_dist.core.errors import KeyFileError
from t4nmtd_dist.wire.auth.keys import ALLOWED, read_public

REREAD_S = 0.5


class AllowedKeys:
    """Public keys with display names, replaceable from any thread."""

    def __init__(self, keys: Iterable[str] = ()) -> None:
        self._names: dict[str, str] = dict.fromkeys(keys, "")

    def replace(self, keys: Iterable[str]) -> None:
        """Allow only these keys from now on."""
        self._names = dict.fromkeys(keys, "")

    def __contains__(self, key: object) -> bool:
        return key in self._names

    def all(self) -> frozenset[str]:
        """All allowed keys."""
        return frozenset(self._names)

    def name(self, key: str) -> str:
        """A key's display name: its name on the list, or its first characters."""
        return self._names.get(key) or f"{key[:8]}…"


class AllowedFolder(AllowedKeys):
    """The allow list in a coordinator's key folder, reread when files come and go.

    An unreadable file allows nobody; without the folder, only ``always`` is allowed.

    Args:
        folder: the key folder; the list is its subfolder ``allowed``.
        always: a key that needs no file: the coordinator's own.
        tell: logs every unreadable file.
    """

    def __init__(self, folder: Path, always: str, tell: Callable[[str], None]) -> None:
        super().__init__()
        self._folder, self._always, self._tell = folder / ALLOWED, always, tell
        self._seen: dict[str, tuple[int, int]] | None = None
        self._read_at = float("-inf")
        self.refresh()

    def refresh(self) -> bool:
        """Reread the list if it has changed, at most twice a second; whether it was reread."""
        now = time.monotonic()
        if now < self._read_at + REREAD_S:
            return False
        self._read_at = now
        found = self._files()
        if found == self._seen:
            return False
        self._seen = found
        self._names = {self._always: "the coordinator"} | dict(filter(None, map(self._read, sorted(found))))
        return True

    def _files(self) -> dict[str, tuple[int, int]]:
        found = {}
        for path in self._folder.glob("*.public"):
            try:
                status = path.stat()
            except OSError:
                continue
            found[path.name] = (status.st_ino, status.st_mtime_ns)
        return found

    def _read(self, file: str) -> tuple[str, str] | None:
        try:
            name, key = read_public(self._folder / file)
        except KeyFileError as error:
            self._tell(f"a key is not allowed: {error}")
            return None
        return key, name
