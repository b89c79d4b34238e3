"""Versions of the software that a run uses."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from t4nmtd_dist.core.version import __version__

PACKAGES = ("torch", "numpy", "gymnasium", "pyzmq", "msgpack", "msgspec", "safetensors", "ltlf2dfa")
SOURCES = Path(__file__).resolve().parents[2]
GIT_S = 5.0


def versions() -> dict[str, str]:
    """Versions of this package (with its Git commit), Python, and the packages that compute."""
    found = {"t4nmtd-dist": __version__, "python": platform.python_version()}
    commit = commit_of(SOURCES)
    if commit:
        found["commit"] = commit
    return found | dict(_installed())


def commit_of(checkout: Path) -> str | None:
    """The checked-out commit, with ``-dirty`` if tracked files differ; None if unknown."""
    if not (checkout / ".git").exists():
        return None
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=GIT_S, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


def _installed() -> Iterator[tuple[str, str]]:
    for name in PACKAGES:
        try:
            yield name, version(name)
        except PackageNotFoundError:
            continue
