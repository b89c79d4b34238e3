"""Builds a checked program from a plan."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from t4nmtd_dist.agents.weights import Weights
from t4nmtd_dist.core.devices import Device
from t4nmtd_dist.environments.cautions import cautions
from t4nmtd_dist.environments.preparation import prepared
from t4nmtd_dist.launch.program import Program, make_roles
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.runs.options import RunOptions
from t4nmtd_dist.runs.planning import RunPlan
from t4nmtd_dist.wire.auth.keys import load_client


def build_program(
    plan: RunPlan,
    options: RunOptions,
    *,
    workers: int | None = None,
    device: Device = "cpu",
    keys: Path | None = None,
    dashboard: bool = False,
    warn: Callable[[str], object] = print,
) -> Program:
    """Build and check a run's program; starts and writes nothing.

    Args:
        plan: of the run.
        options: that the plan was made from.
        workers: number of learner processes; None for one per sub-task.
        device: where they train.
        keys: folder of keys, for a shared machine.
        dashboard: whether to show the run on this terminal.
        warn: logs concerns with the environment.

    Raises:
        ConfigError: if the sub-tasks cannot be divided among ``workers``.
        EnvError: if the environment does not meet the requirements.
        KeyFileError: if the keys cannot be used.
    """
    task = ready_task(plan, options, warn)
    transferred_weights(task, options)  # so that a misfit is told before anything starts
    roles = make_roles(task.decomposition.pids, workers)
    if keys is not None:
        load_client(keys)
    return Program(plan, task, options, roles, keys, device, dashboard)


def transferred_weights(task: CompiledTask, options: RunOptions) -> dict[str, Weights]:
    """The networks that sub-tasks begin with; none without ``transfer_from``.

    Raises:
        PolicyError: if they do not fit the task; names what does not.
    """
    if options.transfer_from is None:
        return {}
    from t4nmtd_dist.environments.timed import make_task_env
    from t4nmtd_dist.policy.transfer import read_source, transferred

    return transferred(read_source(options.transfer_from), task, make_task_env(task.config, 1).observation_size)


def ready_task(plan: RunPlan, options: RunOptions, warn: Callable[[str], object]) -> CompiledTask:
    """Compile the task, check its environment, and resolve settings that depend on it.

    Raises:
        EnvError: if the environment does not meet the requirements.
    """
    task = prepared(compile_task(plan.config, translator=options.translator, seed=plan.seed))
    for text in cautions(task):
        warn(text)
    return task
