"""Trains a task from a Python program or a notebook."""

from __future__ import annotations

import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import tomli_w

from t4nmtd_dist.api.progress import show_progress
from t4nmtd_dist.api.result import TrainingResult
from t4nmtd_dist.api.task import Task
from t4nmtd_dist.core.devices import Device, check_device
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.core.registry import LAUNCHERS
from t4nmtd_dist.launch.build import build_program
from t4nmtd_dist.launch.run import launch
from t4nmtd_dist.runs.options import RunOptions
from t4nmtd_dist.runs.planning import RunPlan, plan_run, plan_task
from t4nmtd_dist.runs.resuming import SERIAL
from t4nmtd_dist.tasks.given import same_code

SHARES_OBJECTS = ("forked", SERIAL)
"""Launchers whose roles have the objects of this process."""


def train(
    task: Task | str,
    *,
    seed: int = 0,
    serial: bool = False,
    workers: int | None = None,
    max_interactions: int | None = None,
    run_dir: str | Path | None = None,
    resume: bool = False,
    device: Device = "cpu",
    progress: bool = True,
    launcher: str | None = None,
) -> TrainingResult:
    """Train until the task is solved, the budget is spent, or Ctrl-C; blocks until then.

    Example::

        result = train(Task(formula="F(left & X(F(flag)))", env=make, labels=labels, horizon=40))
        print(result, result.policy.act(observation, {"left"}))

    Args:
        task: a ``Task``, or an argument of ``Task.load``.
        seed: of networks, exploration and environments.
        serial: one lock-step, bit-reproducible process instead of one per sub-task.
        workers: number of learner processes; None for one per sub-task.
        max_interactions: budget of all learners' environment steps; None for the task's own.
        run_dir: run directory; None for ``runs/NAME/UTC-sSEED``.
        resume: continue the stopped run in ``run_dir``; task and seed must be the same.
        device: where the networks are trained.
        progress: show a progress line.
        launcher: a key of ``core.registry.LAUNCHERS``; None for ``serial`` if set, else ``forked`` on Linux and
            ``local`` elsewhere.

    Returns:
        The outcome, also of an interrupted run.

    Raises:
        ConfigError: if the arguments contradict each other or the task.
        EnvError: if the environment does not meet the method's requirements.
        RunError: if ``run_dir`` already holds a run, or a process cannot continue.
    """
    task = Task.load(task) if isinstance(task, str) else task
    name = launcher or (SERIAL if serial else "forked" if sys.platform == "linux" else "local")
    _check(task, name, serial)
    check_device(device)
    folder = None if run_dir is None else Path(run_dir)
    options = RunOptions(
        seed=seed, max_interactions=max_interactions, run_dir=folder, resume=folder if resume else None
    )
    plan = _resumed(task, options, name) if resume else plan_task(task.config, options, serial=name == SERIAL)
    if plan.solved:
        return TrainingResult.of(plan.directory)
    with _named_task(plan, options, name) as named:
        program = build_program(plan, named, workers=None if name == SERIAL else workers, device=device, warn=_warn)
        launch(program, name, show=show_progress if progress else None)
    return TrainingResult.of(plan.directory)


def _check(task: Task, launcher: str, serial: bool) -> None:
    LAUNCHERS.check(launcher, "launcher")
    if serial and launcher != SERIAL:
        raise ConfigError(f"launcher={launcher!r} and serial=True contradict each other: give one of them")
    if task.needs_this_process and launcher not in SHARES_OBJECTS:
        raise ConfigError(
            f"launcher {launcher!r} starts programs that cannot import functions of a notebook or of the script that "
            f"is running: put them into a module, or choose one of {', '.join(SHARES_OBJECTS)}"
        )


def _resumed(task: Task, options: RunOptions, launcher: str) -> RunPlan:
    """The plan to continue a run of this task.

    Raises:
        ConfigError: if no run is named, or it is of another task.
    """
    if options.resume is None:
        raise ConfigError("resume=True continues the run in run_dir: pass run_dir, too")
    plan = plan_run(options, serial=launcher == SERIAL, warn=_warn)
    own, theirs = task.config.environment, plan.config.environment
    same_functions = same_code(own.id, theirs.id) and same_code(own.labels, theirs.labels)
    if plan.config.formula != task.config.formula or not same_functions:
        raise ConfigError(
            f"the run in {plan.directory} is of another task: {plan.config.formula!r} in "
            f"{theirs.id!r}, not {task.config.formula!r} in {own.id!r}"
        )
    functions = replace(theirs, id=own.id, labels=own.labels)
    return replace(plan, config=replace(plan.config, environment=functions))


@contextmanager
def _named_task(plan: RunPlan, options: RunOptions, launcher: str) -> Iterator[RunOptions]:
    """Options naming a task file, for coordinators that must read one."""
    if launcher in SHARES_OBJECTS or plan.resumes:
        yield options
        return
    with tempfile.TemporaryDirectory(prefix="t4nmtd-") as folder:
        file = Path(folder) / "task.toml"
        file.write_text(tomli_w.dumps(plan.config.to_dict()), encoding="utf-8")
        yield replace(options, task=str(file))


def _warn(text: str) -> None:
    warnings.warn(text, stacklevel=2)
