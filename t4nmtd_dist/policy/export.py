"""Files of an exported policy, replaced while others may read them; used by ``t4nmtd_dist.policy.load``.

A new export is written under another name and renamed when complete. A reader opens the folder first, so that both
files match, and retries if they were replaced meanwhile.
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
LEARNERS_FILE = "learners.safetensors"
"""All parameters of the learners of a solved run, for ``policy.transfer``; a policy acts without it."""
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
    learners: bool = False,
) -> None:
    """Write the global policy to a new folder, then replace ``folder`` by two renames.

    Args:
        folder: the destination.
        task: the compiled task.
        q_table: known entries of Q(q, T).
        weights: parameters by pid; the policy has those of the acting actors.
        about: its origin (interactions, versions, seed).
        mode: action mode it was evaluated in.
        learners: keep all parameters, too, for a transfer to another task.

    Raises:
        OSError: if it cannot be written.
    """
    fresh, old = _beside(folder)
    for left_behind in (fresh, old):
        shutil.rmtree(left_behind, ignore_errors=True)
    fresh.mkdir(parents=True)
    _save({pid: acting_parameters(named) for pid, named in weights.items()}, fresh / ACTORS_FILE)
    if learners:
        _save(weights, fresh / LEARNERS_FILE)
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


def _save(weights: Mapping[str, Mapping[str, NDArray[Any]]], path: Path) -> None:
    arrays = {
        f"{pid}/{name}": np.ascontiguousarray(array) for pid, named in weights.items() for name, array in named.items()
    }
    try:
        save_file(arrays, path)
    except SafetensorError as error:
        raise OSError(f"{path}: {error}") from None


def _beside(folder: Path) -> tuple[Path, Path]:
    """Temporary folders of the new export and of the replaced one."""
    return folder.with_name(folder.name + ".new"), folder.with_name(folder.name + ".old")


def mend_export(folder: Path) -> None:
    """Restore a policy after a kill between the two renames of an export.

    Prefers the newer one, if complete.
    """
    if folder.exists():
        return
    for found in _beside(folder):
        with suppress(OSError, ValueError):  # half written, or not there
            _read_once(found)
            os.replace(found, folder)
            return


def read_export(*folders: Path) -> tuple[Path, Any, dict[str, NDArray[Any]]]:
    """The first folder with an export, the content of its ``policy.json``, and its arrays by ``pid/actor.*``.

    Raises:
        FileNotFoundError: if there is none, even after waiting a second for one being written.
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
    """Read a file of an open folder, even if the folder was renamed."""
    with open(os.open(name, os.O_RDONLY, dir_fd=opened), "rb") as file:
        return file.read()


def _being_replaced(folder: Path) -> bool:
    """Whether an export is in progress or has just finished."""
    return any(path.exists() for path in _beside(folder)) or (
        (folder / POLICY_FILE).exists() and (folder / ACTORS_FILE).exists()
    )
