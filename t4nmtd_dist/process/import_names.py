"""Refuses to start if another package hides one of ours."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

from t4nmtd_dist.core.errors import ImportNameError

PACKAGES = ("coordinator", "workers", "envs")


def check_import_names() -> None:
    """Check, without importing them, that Python finds this distribution's own packages.

    Raises:
        ImportNameError: with the package that hides ours, and what to do.
    """
    installed = Path(__file__).resolve().parents[2]
    for name in PACKAGES:
        found = _found(name)
        if found != installed / name / "__init__.py":
            raise ImportNameError(_told(name, found, installed))


def _found(name: str) -> Path | None:
    """What ``import name`` would load."""
    try:
        spec = importlib.util.find_spec(name)
    except ValueError:  # a module without a spec
        return None
    if spec is None:
        return None
    places = [spec.origin] if spec.origin else list(spec.submodule_search_locations or ())
    return Path(places[0]).resolve() if places else None


def _told(name: str, found: Path | None, installed: Path) -> str:
    if found is None:
        return f"the package {name} of t4nmtd-dist, installed in {installed}, is not found; install t4nmtd-dist again"
    folder = found.parent.parent if found.name == "__init__.py" else found.parent
    listed = os.environ.get("PYTHONPATH", "")
    through = folder in [Path(entry).resolve() for entry in listed.split(os.pathsep)] and bool(listed)
    how, cure = ("through PYTHONPATH", f"take {folder} out of PYTHONPATH") if through else _elsewhere(folder)
    return (
        f"{found} (found {how}) hides the package {name} of t4nmtd-dist, installed in {installed}; {cure}, "
        "or rename that package"
    )


def _elsewhere(folder: Path) -> tuple[str, str]:
    if sys.path and Path(sys.path[0]).resolve() == folder:
        return f"in {folder}, where Python looks first", "start the program from another folder"
    return f"in {folder}", f"take {folder} off Python's path"
