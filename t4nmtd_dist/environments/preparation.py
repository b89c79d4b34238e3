"""Checks a task's environment before a run starts."""

from __future__ import annotations

import dataclasses

import numpy as np

from t4nmtd_dist.core.config import EnvironmentConfig, TaskConfig
from t4nmtd_dist.core.errors import EnvError, T4NMTDError
from t4nmtd_dist.environments.user_errors import described
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.tasks import is_bundled, load_task

SLOW = (
    "states of environment {id!r} are restored by replaying actions from a seeded reset, which is slow and counts as "
    "interactions, and an episode is cut after {horizon} steps; give it get_state and set_state to be faster "
    "(docs/own-task.md)"
)


def prepared(task: CompiledTask) -> CompiledTask:
    """Check a task's environment; of a bundled one, only the fit of a changed formula, propositions or algorithm.

    Returns:
        The task with environment-dependent settings resolved, so that all workers agree: snapshots, algorithm, and
        normalisation of observations.

    Raises:
        EnvError: if the environment cannot be opened, reset, stepped, labelled or restored, has spaces that the learner
            cannot use, or does not report a proposition of the formula.
    """
    if is_bundled(task.config):
        return _check_env(task) if _asks_for_more(task.config) else task
    try:
        return _checked(task)
    except T4NMTDError:
        raise
    except Exception as error:  # user code may raise anything
        raise EnvError(f"environment {task.config.environment.id!r} raised {described(error)}") from error


def _asks_for_more(config: TaskConfig) -> bool:
    """Whether a bundled task requires more of its environment."""
    known = load_task(config.name)
    return (config.learner.algorithm, config.formula, config.propositions) != (
        known.learner.algorithm,
        known.formula,
        known.propositions,
    )


def _check_env(task: CompiledTask) -> CompiledTask:
    from t4nmtd_dist.environments.decisions import decided
    from t4nmtd_dist.environments.timed import make_task_env

    env = make_task_env(task.config, 1)
    task = dataclasses.replace(task, config=decided(task.config, env.action_space))
    check_fit(task, env.propositions, env.action_space)
    return task


def slowness(config: EnvironmentConfig) -> str | None:
    """A warning if states are restored by replay."""
    return SLOW.format(id=config.id, horizon=config.horizon) if config.snapshots == "replay" else None


def _checked(task: CompiledTask) -> CompiledTask:
    from t4nmtd_dist.environments.decisions import decided
    from t4nmtd_dist.environments.snapshot_choice import choose_snapshots, with_choice
    from t4nmtd_dist.environments.timed import make_task_env

    config = task.config
    environment = with_choice(config.environment, choose_snapshots(config.environment, config.propositions))
    env = make_task_env(dataclasses.replace(config, environment=environment), 1)
    task = dataclasses.replace(
        task, config=decided(dataclasses.replace(config, environment=environment), env.action_space)
    )
    check_fit(task, env.propositions, env.action_space)
    env.reset(np.arange(1), 0)
    env.step(np.array([env.action_space.sample()]))
    return task


def check_fit(task: CompiledTask, propositions: tuple[str, ...], action_space: object) -> None:
    """Check that the environment reports the formula's propositions and suits the learner.

    Raises:
        EnvError: if not.
    """
    from t4nmtd_dist.environments.action_spaces import check_action_space
    from t4nmtd_dist.method.rewards import SymbolReader

    SymbolReader(task.dfa, propositions)
    check_action_space(task.config, action_space)
