"""Imports modules named by a task file, even if they share a name with ours: ``envs``, ``workers``, ``coordinator``.

The task's folder comes first on Python's path, so its modules usually have their plain names. A module shadowed by ours
or an imported one is loaded under a private name: ``_t4nmtd_task_<folder's hash>.<name>``, a package whose path is the
task's folder (docs/decisions/021).
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from collections.abc import Sequence
from hashlib import sha256
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType

import gymnasium as gym

OURS = ("t4nmtd_dist", "coordinator", "workers", "envs")
OUR_WORLDS = "envs:t4nmtd/"  # id prefix of our environments, even if another module is called envs


def import_task_module(name: str, folders: Sequence[str]) -> ModuleType:
    """Import a module named by a task, searching ``folders`` first; repeated imports give the same object.

    Raises:
        Exception: anything that the import raises.
    """
    if not folders:
        return importlib.import_module(name)
    for ours in OURS:  # once imported, nothing on the path can shadow them
        importlib.import_module(ours)
    sys.path[:0] = [folder for folder in folders if folder not in sys.path]
    known = set(gym.registry)
    module = importlib.import_module(_importable(name, folders))
    _redirect(set(gym.registry) - known, folders)
    return module


def explained(error: ImportError, folders: Sequence[str]) -> str:
    """A hint for a failed import if one of our packages shadowed the user's; else ""."""
    top = (error.name or "").partition(".")[0]
    folder = _folder_of(top, folders) if top in OURS else None
    if folder is None:
        return ""
    return (
        f"; {top} is a package of t4nmtd-dist here, not the one in {folder}: rename yours, or let the task file name "
        f"its modules ({top}.module:make) and let these import each other relatively (from . import ...)"
    )


def _folder_of(top: str, folders: Sequence[str]) -> str | None:
    """The first folder with a module or package of this name."""
    return next((folder for folder in folders if PathFinder.find_spec(top, [folder]) is not None), None)


def _importable(name: str, folders: Sequence[str]) -> str:
    """Import name of the module in the first folder that has it."""
    folder = _folder_of(name.partition(".")[0], folders)
    return _private(name, folder) if folder is not None and _is_hidden(name, folder) else name


def _is_hidden(name: str, folder: str) -> bool:
    """Whether the folder's module is shadowed under its plain name."""
    top, _, rest = name.partition(".")
    theirs = PathFinder.find_spec(top, [folder])
    if theirs is None:
        return False
    if theirs.origin is None:  # a namespace package: Python prefers any module to it
        inner = PathFinder.find_spec(rest.partition(".")[0], list(theirs.submodule_search_locations or ()))
        return top in OURS and bool(rest) and inner is not None
    try:
        plain = importlib.util.find_spec(top)
    except ValueError:  # a hand-made module without a spec
        return True
    return plain is None or _place(plain) != _place(theirs)


def _place(spec: ModuleSpec) -> str:
    return os.path.realpath(spec.origin or "")


def _private(name: str, folder: str) -> str:
    parent = f"_t4nmtd_task_{sha256(folder.encode()).hexdigest()[:12]}"
    if parent not in sys.modules:
        package = ModuleType(parent, f"The modules in {folder} whose names are taken.")
        package.__path__ = [folder]
        sys.modules[parent] = package
    return f"{parent}.{name}"


def _redirect(registered: set[str], folders: Sequence[str]) -> None:
    """Point new registrations to the private names of shadowed modules."""
    for spec in (gym.registry[name] for name in registered):
        if isinstance(spec.entry_point, str):
            module, colon, attribute = spec.entry_point.partition(":")
            spec.entry_point = f"{_importable(module, folders)}{colon}{attribute}"
