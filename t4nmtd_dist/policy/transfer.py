"""Transfer: networks of a solved task's sub-tasks as the beginning of those of the same name (paper, experiment 4).

Kept are actors, critics, targets, averages and entropy coefficients. Optimisers, replay, start states, Q and
exploration begin new, as do sub-tasks without a namesake. Observations must have the same numbers in both tasks. DFA
states need not: each column of the one-hot begins as the mean of the source's columns over the DFA states in which the
sub-task was available there.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file

from t4nmtd_dist.agents.common.normalisation import stored_normalisation
from t4nmtd_dist.agents.modules import shapes_module
from t4nmtd_dist.agents.weight_checks import NetworkSizes, check_weights, sizes_of
from t4nmtd_dist.agents.weights import Weights, networks_of
from t4nmtd_dist.core.config import TaskConfig, task_config
from t4nmtd_dist.core.errors import ConfigError, PolicyError
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.policy.export import LEARNERS_FILE, POLICY_FILE


@dataclass(frozen=True)
class Source:
    """The learners of a solved run.

    Attributes:
        folder: of its policy.
        config: settings of its task.
        dfa_states: number of its DFA states.
        weights: all parameters of every learner by pid.
    """

    folder: Path
    config: TaskConfig
    dfa_states: int
    decomposition: Decomposition
    weights: Mapping[str, Weights]


def read_source(path: Path) -> Source:
    """Read the learners in a run directory or its policy folder.

    Raises:
        PolicyError: if there are none, or they are damaged.
    """
    folder = path if (path / POLICY_FILE).exists() else path / "policy"
    if not (folder / LEARNERS_FILE).exists():
        raise PolicyError(
            f"no {LEARNERS_FILE} in {folder}: --transfer-from takes a solved run, or its policy folder; "
            "runs that were not solved, and policies of earlier versions, have none"
        )
    try:
        data = json.loads((folder / POLICY_FILE).read_text(encoding="utf-8"))
        arrays = load_file(folder / LEARNERS_FILE)
        config = task_config(data["task"], source=str(folder))
        decomposition = Decomposition.from_json(data["decomposition"])
        states = int(data["dfa"]["states"])
    except (OSError, ValueError, KeyError, TypeError, SafetensorError, ConfigError) as error:
        raise PolicyError(f"the learners in {folder} cannot be read ({type(error).__name__}: {error})") from None
    weights: dict[str, Weights] = {}
    for key, array in arrays.items():
        pid, _, name = key.partition("/")
        weights.setdefault(pid, {})[name] = array
    return Source(folder, config, states, decomposition, weights)


def transferred(source: Source, task: CompiledTask, observation_size: int) -> dict[str, Weights]:
    """The weights with which the sub-tasks of ``task`` begin that have a namesake in the source.

    Args:
        source: a solved run.
        task: what is to be trained.
        observation_size: numbers in an observation of its environment.

    Raises:
        PolicyError: if no sub-task has a namesake, or algorithm, widths or observations differ; names what does.
    """
    ours, theirs = task.config.learner, source.config.learner
    for key in ("algorithm", "hidden", "normalise_observations"):
        if getattr(ours, key) != getattr(theirs, key):
            raise PolicyError(
                f"cannot transfer from {source.folder}: it has learner.{key} = {getattr(theirs, key)!r}, this task has "
                f"{getattr(ours, key)!r}; they must be equal"
            )
    if any(any(networks_of(weights)) for weights in source.weights.values()):
        raise PolicyError(
            f"cannot transfer from {source.folder}: learner.method = {theirs.method!r} has one learner with several "
            "networks; expected one learner per sub-task, as in t4nmtd"
        )
    shared = [pid for pid in task.decomposition.pids if pid in source.weights]
    if not shared:
        raise PolicyError(
            f"cannot transfer from {source.folder}: its sub-tasks are {', '.join(source.weights)}, those of this task "
            f"{', '.join(task.decomposition.pids)}; none has the same name"
        )
    found = {pid: _mapped(source, task, pid, observation_size) for pid in shared}
    sizes: NetworkSizes | None = None
    for weights in found.values():
        sizes = check_weights(weights, task.config, task.dfa.states, sizes)
    return found


def _mapped(source: Source, task: CompiledTask, pid: str, observation_size: int) -> Weights:
    statistics, weights = stored_normalisation(source.weights[pid])
    sizes = sizes_of(weights, source.config, source.dfa_states)
    if sizes.observation != observation_size:
        raise PolicyError(
            f"cannot transfer {pid} from {source.folder}: it sees observations of {sizes.observation} numbers, this "
            f"task's environment has {observation_size}"
        )
    available = sorted({q for q, _ in source.decomposition.subtasks[pid]})
    axes = _input_axes(source.config, sizes, source.dfa_states)
    mapped = {
        name: _with_columns(array, axes[name], sizes.observation, source.dfa_states, available, task.dfa.states)
        for name, array in weights.items()
    }
    kept = {name: array for name, array in source.weights[pid].items() if name not in weights}
    return mapped if statistics is None else mapped | kept


def _input_axes(config: TaskConfig, sizes: NetworkSizes, states: int) -> dict[str, int | None]:
    """The axis of every parameter along which product states are read; None if there is none."""
    shapes = shapes_module(config.learner.algorithm)
    inputs = sizes.observation + states
    one, longer = (shapes.parameter_shapes(config, length, sizes.action) for length in (inputs, inputs + 1))
    return {
        name: next((i for i, (a, b) in enumerate(zip(one[name], longer[name], strict=True)) if a != b), None)
        for name in one
    }


def _with_columns(
    array: NDArray[Any], axis: int | None, first: int, states: int, available: list[int], wanted: int
) -> NDArray[Any]:
    """The parameter with ``wanted`` equal columns in place of those of the ``states`` DFA states from ``first`` on."""
    if axis is None:
        return array
    before, columns, after = np.split(array, [first, first + states], axis=axis)
    mean = columns.take(available, axis=axis).mean(axis=axis, keepdims=True)
    return np.ascontiguousarray(np.concatenate([before, mean.repeat(wanted, axis=axis), after], axis=axis))
