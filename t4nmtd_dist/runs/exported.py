"""Writing an exported policy; ``t4nmtd_dist.policy.load`` reads it."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import save_file

from t4nmtd_dist.action_modes import ActionMode
from t4nmtd_dist.compiled import CompiledTask
from t4nmtd_dist.high_level import QEntries
from t4nmtd_dist.learners.actors import acting_parameters

POLICY_FORMAT = 1
POLICY_FILE = "policy.json"
ACTORS_FILE = "actors.safetensors"


def export_policy(
    folder: Path,
    task: CompiledTask,
    q_table: QEntries,
    weights: Mapping[str, Mapping[str, NDArray[Any]]],
    about: Mapping[str, Any],
    *,
    mode: ActionMode = "greedy",
) -> None:
    """Write the global policy into ``folder``, replacing what is there only once all is written.

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
    fresh = folder.with_name(folder.name + ".new")
    shutil.rmtree(fresh, ignore_errors=True)
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
    shutil.rmtree(folder, ignore_errors=True)
    os.replace(fresh, folder)
