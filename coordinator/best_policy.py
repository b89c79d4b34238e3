"""Exports a run's best policy, and reads it back on resume."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
from numpy.typing import NDArray

from coordinator.evaluations import EvaluatedPolicy, PolicySnapshot
from coordinator.state import CoordinatorState
from t4nmtd_dist.policy.export import export_policy, mend_export, read_export
from t4nmtd_dist.runs.checkpoints import Warn
from t4nmtd_dist.wire.messages import EvaluationRow


def export_best(state: CoordinatorState, folder: Path) -> None:
    """Export the best policy so far, if there is one.

    Raises:
        OSError: if it cannot be written.
    """
    best = state.evaluations.best
    if best is None:
        return
    row, snapshot = best.row, best.snapshot
    about = {
        "interactions": row.interactions,
        "evaluation": row.job,
        "success_rate": row.success_rate,
        "episodes": state.task.config.evaluation.episodes,
        "actions": row.actions,
        "versions": snapshot.versions,
        "seed": state.settings.seed,
        "outcome": state.outcome,
        "row": msgspec.to_builtins(row),
    }
    learners = state.outcome == "solved" and all(map(_is_whole, snapshot.weights.values()))
    export_policy(folder, state.task, snapshot.q_table, snapshot.weights, about, mode=row.actions, learners=learners)


def _is_whole(weights: Mapping[str, NDArray[Any]]) -> bool:
    """Whether weights are a learner's, not those that an earlier export kept of it."""
    return any(name.partition(".")[0] not in ("actor", "normalisation") for name in weights)


def consider_exported(state: CoordinatorState, folder: Path, warn: Warn) -> None:
    """Add the exported policy to the evaluated ones: it may be newer and better than the checkpoint's.

    Args:
        state: of the run that exported it.
        folder: the export folder, which may not exist.
        warn: called if the policy cannot be read.
    """
    mend_export(folder)
    try:
        _, data, arrays = read_export(folder)
        exported = _evaluated(data, arrays)
    except FileNotFoundError:
        return
    except (OSError, ValueError, TypeError, LookupError) as error:
        warn(f"the policy in {folder} cannot be read, so it will be replaced: {type(error).__name__}: {error}")
        return
    state.evaluations.consider(exported)


def _evaluated(data: Any, arrays: Mapping[str, NDArray[Any]]) -> EvaluatedPolicy:
    weights: dict[str, dict[str, NDArray[Any]]] = {}
    for key, array in arrays.items():
        pid, _, name = key.partition("/")
        weights.setdefault(pid, {})[name] = array
    row = msgspec.convert(data["about"]["row"], EvaluationRow)
    versions = msgspec.convert(data["about"]["versions"], dict[str, int])
    q_table = msgspec.convert(data["q_table"], list[tuple[int, str, float]])
    return EvaluatedPolicy(PolicySnapshot(row.job, row.interactions, q_table, versions, weights), row)
