"""Warnings before a training, one line each."""

from __future__ import annotations

import time

from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.core.errors import EnvError, T4NMTDError
from t4nmtd_dist.environments.preparation import slowness
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.tasks import is_packages_environment

STEPS, MOST_S = 200, 5.0  # limits of random play


def cautions(task: CompiledTask) -> list[str]:
    """Warnings about a task whose environment was checked (``preparation.prepared``).

    Raises:
        EnvError: if the environment fails under random actions.
    """
    config = task.config
    slow = slowness(config.environment)
    found = [] if slow is None else [slow]
    if is_packages_environment(config.environment):
        return found
    try:
        return found + _of_observations(config)
    except T4NMTDError:
        raise
    except Exception as error:  # user code may raise anything
        raise EnvError(f"environment {config.environment.id!r} raised {type(error).__name__}: {error}") from error


def _of_observations(config: TaskConfig) -> list[str]:
    from t4nmtd_dist.environments.observation_range import ObservationRange
    from t4nmtd_dist.environments.single_env import SingleEnv

    env = SingleEnv(config.environment, config.propositions)
    seen = ObservationRange(env.parts)
    env.action_space.seed(0)
    seen.note(env.reset(0))
    ends_at, episode = time.monotonic() + MOST_S, 0
    for _ in range(STEPS):
        step, episode = env.step(env.action_space.sample()), episode + 1
        seen.note(step.observation)
        if step.terminated or step.truncated or episode >= config.environment.horizon:
            seen.note(env.reset(None))
            episode = 0
        if time.monotonic() > ends_at:
            break
    env.env.close()
    return seen.warnings(normalised=config.learner.normalise_observations == "on")
