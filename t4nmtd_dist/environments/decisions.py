"""Settings that a task file may leave to its environment (``auto``), decided once, before a run starts."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import msgspec
from gymnasium import spaces

from t4nmtd_dist.core.config import ALGORITHM_DEFAULTS, LearnerConfig, TaskConfig
from t4nmtd_dist.tasks import is_packages_environment

Algorithm = Literal["ppo", "sac"]


def decided(config: TaskConfig, action_space: object) -> TaskConfig:
    """The settings without ``auto`` for the algorithm and for the normalisation of observations.

    Args:
        config: of any task.
        action_space: of its environment. Discrete calls for PPO, anything else for SAC; whether SAC can act in it is
            the affair of ``check_action_space``.
    """
    if config.learner.algorithm == "auto":
        config = with_algorithm(config, "ppo" if isinstance(action_space, spaces.Discrete) else "sac")
    if config.learner.normalise_observations == "auto":
        needed = not is_packages_environment(config.environment)
        learner = dataclasses.replace(config.learner, normalise_observations="on" if needed else "off")
        config = dataclasses.replace(config, learner=learner)
    return config


def with_algorithm(config: TaskConfig, algorithm: Algorithm) -> TaskConfig:
    """The settings with an algorithm, and its own defaults for whatever was not given."""
    plain, learner = LearnerConfig(), config.learner
    own: dict[str, Any] = ALGORITHM_DEFAULTS.get(algorithm, {}).get("learner", {})
    free = {
        key: value
        for key, value in own.items()
        if key not in config.learner_given and getattr(learner, key) == getattr(plain, key)
    }
    changes = vars(msgspec.convert(free, LearnerConfig))
    learner = dataclasses.replace(learner, algorithm=algorithm, **{key: changes[key] for key in free})
    return dataclasses.replace(config, learner=learner)
