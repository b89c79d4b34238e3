"""Loads an exported policy; ``policy.export`` describes its files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.config import TaskConfig, task_config
from t4nmtd_dist.core.errors import ConfigError, PolicyError
from t4nmtd_dist.core.method_settings import method_configs
from t4nmtd_dist.core.registry import AGENTS
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.policy.export import ACTORS_FILE, POLICY_FILE, POLICY_FORMAT, read_export
from t4nmtd_dist.policy.global_policy import ActorWeights, GlobalPolicy

TRAINING_KEYS = {"max_interactions", "decomposition", "high_level", "evaluation", *AGENTS.modules}
ACTING_LEARNER_KEYS = {"method", "algorithm", "gamma", "hidden", "normalise_observations"}


@dataclass(frozen=True)
class ExportedTask:
    """The parts of a task in an export; see ``PolicyTask``."""

    config: TaskConfig
    dfa: DFA
    decomposition: Decomposition
    rho: NDArray[np.float64]


def load(path: str | Path, *, seed: int | None = None) -> GlobalPolicy:
    """Load an exported policy from its folder or a run directory.

    Args:
        path: the folder or the run directory.
        seed: for sampled actions; None for a random one.

    Raises:
        PolicyError: if the policy is missing, damaged, or of another format version.
    """
    folder, data, arrays = _read(Path(path))
    found = data.get("format") if isinstance(data, dict) else None
    if found != POLICY_FORMAT:
        raise PolicyError(f"{folder}: policy format {found!r}; this program reads {POLICY_FORMAT}")
    actors: dict[str, dict[str, NDArray[Any]]] = {}
    for key, array in arrays.items():
        pid, _, name = key.partition("/")
        actors.setdefault(pid, {})[name] = array
    try:
        return _restored(data, actors, folder, seed)
    except (ConfigError, LookupError, TypeError, ValueError) as error:
        raise PolicyError(f"the policy in {folder} is damaged ({type(error).__name__}: {error})") from None


def _restored(data: Mapping[str, Any], actors: ActorWeights, folder: Path, seed: int | None) -> GlobalPolicy:
    task = ExportedTask(
        task_config(_acting_settings(data["task"]), source=str(folder)),
        DFA.from_json(data["dfa"]),
        Decomposition.from_json(data["decomposition"]),
        np.array(data["rho"], np.float64).reshape(int(data["dfa"]["states"])),
    )
    q_table = [(q, pid, value) for q, pid, value in data["q_table"]]
    return GlobalPolicy(task, q_table, actors, mode=data.get("actions", "greedy"), seed=seed)


def _acting_settings(task: Mapping[str, Any]) -> dict[str, Any]:
    """A task's settings without the training settings, which change between versions."""
    learner = {key: value for key, value in task["learner"].items() if key in ACTING_LEARNER_KEYS}
    training = TRAINING_KEYS | method_configs().keys()
    return {key: value for key, value in task.items() if key not in training} | {"learner": learner}


def _read(path: Path) -> tuple[Path, Any, dict[str, NDArray[Any]]]:
    """The export in ``path`` or ``path/policy``."""
    try:
        return read_export(path, path / "policy")
    except FileNotFoundError:
        raise PolicyError(
            f"no policy in {path}; expected {POLICY_FILE} and {ACTORS_FILE} there or in {path / 'policy'}, where a run "
            "exports its best policy after its first evaluation"
        ) from None
    except (OSError, ValueError) as error:
        raise PolicyError(f"cannot read the policy in {path}: {error}") from None
