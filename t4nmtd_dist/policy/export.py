"""The files of an exported policy, which is replaced while others may read it; ``t4nmtd_dist.policy.load`` uses them.

A new export is written under another name and renamed once it is whole. A reader opens the folder first and reads
both files from what it opened, so that they belong together. It tries again if they were replaced meanwhile.
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save_file

from t4nmtd_dist.agents.weights import acting_parameters
from t4nmtd_dist.core.action_modes import ActionMode
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.method.high_level import QEntries

POLICY_FORMAT = 1
POLICY_FILE = "policy.json"
ACTORS_FILE = "actors.safetensors"
PATIENCE_S = 1.0
RETRY_S = 0.01


def export_policy(
    folder: Path,
    task: CompiledTask,
    q_table: QEntries,
    weights: Mapping[str, Mapping[str, NDArray[Any]]],
    about: Mapping[str, Any],
    *,
    mode: ActionMode = "greedy",
) -> None:
    """Write the global policy into ``folder``, replacing what is there by two renames once all is written.

    Args:
        folder: its new home.
        task: the compiled task.
        q_table: known entries of Q(q, T).
        weights: by pid, all parameters; only those of the actors that act are kept.
        about: where it comes from (interactions, versions, seed), for readers.
        mode: how the policy is to act unless told otherwise: in the way in which it was evaluated.

    Raises:
        OSError: if it cannot be written.
    """
    fresh, old = _beside(folder)
    for left_behind in (fresh, old):
        shutil.rmtree(left_behind, ignore_errors=True)
    fresh.mkdir(parents=True)
    actors = {
        f"{pid}/{name}": np.ascontiguousarray(array)
        for pid, named in weights.items()
        for name, array in acting_parameters(named).items()
    }
    try:
        save_file(actors, fresh / ACTORS_FILE)
    except SafetensorError as error:
        raise OSError(f"{fresh / ACTORS_FILE}: {error}") from None
    data = {
        "format": POLICY_FORMAT,
        "about": dict(about),
        "actions": mode,
        "task": task.config.to_dict(),
        "dfa": task.dfa.to_json(),
        "decomposition": task.decomposition.to_json(),
        "q_table": q_table,
        "rho": [float(x) for x in task.rho],
    }
    (fresh / POLICY_FILE).write_text(json.dumps(data, indent=1), encoding="utf-8")
    if folder.exists():
        os.replace(folder, old)
    os.replace(fresh, folder)
    shutil.rmtree(old, ignore_errors=True)


def _beside(folder: Path) -> tuple[Path, Path]:
    """Where an export is written, and where the one before goes until it is deleted."""
    return folder.with_name(folder.name + ".new"), folder.with_name(folder.name + ".old")


def mend_export(folder: Path) -> None:
    """Put a policy back that a kill between the two renames of an export has left beside its folder.

    The newer one is preferred, if it is whole.
    """
    if folder.exists():
        return
    for found in _beside(folder):
        with suppress(OSError, ValueError):  # half written, or not there
            _read_once(found)
            os.replace(found, folder)
            return


def read_export(*folders: Path) -> tuple[Path, Any, dict[str, NDArray[Any]]]:
    """The first of some folders that holds an export, what its ``policy.json`` says, and its arrays by ``pid/actor.*``.

    Raises:
        FileNotFoundError: if none does, and none came within a second although one was being written.
        OSError: if the export cannot be read.
        ValueError: if it is damaged.
    """
    deadline = time.monotonic() + PATIENCE_S
    while True:
        for folder in folders:
            with suppress(FileNotFoundError):
                return folder, *_read_once(folder)
        if time.monotonic() > deadline or not any(_being_replaced(folder) for folder in folders):
            raise FileNotFoundError(f"no {POLICY_FILE} with {ACTORS_FILE} in {' or '.join(map(str, folders))}")
        time.sleep(RETRY_S)


def _read_once(folder: Path) -> tuple[Any, dict[str, NDArray[Any]]]:
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        data, arrays = (_read_in(opened, name) for name in (POLICY_FILE, ACTORS_FILE))
    finally:
        os.close(opened)
    try:
        return json.loads(data.decode("utf-8")), load(arrays)
    except SafetensorError as error:
        raise ValueError(f"{ACTORS_FILE}: {error}") from None


def _read_in(opened: int, name: str) -> bytes:
    """A file of an open folder, wherever that is by now."""
    with open(os.open(name, os.O_RDONLY, dir_fd=opened), "rb") as file:
        return file.read()


def _being_replaced(folder: Path) -> bool:
    """Whether an export is under way, or has just come to its end."""
    return any(path.exists() for path in _beside(folder)) or (
        (folder / POLICY_FILE).exists() and (folder / ACTORS_FILE).exists()
    )
