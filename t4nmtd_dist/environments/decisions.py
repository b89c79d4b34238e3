"""Resolves settings that depend on the environment (``auto``) before a run starts."""

from __future__ import annotations

import dataclasses

import msgspec
from gymnasium import spaces

from t4nmtd_dist.core.agent_settings import agent_for, agent_settings
from t4nmtd_dist.core.config import LearnerConfig, TaskConfig
from t4nmtd_dist.tasks import is_packages_environment


def decided(config: TaskConfig, action_space: object) -> TaskConfig:
    """Resolve ``auto`` for the algorithm and the normalisation of observations.

    A Discrete action space selects an agent for discrete actions, any other one for continuous actions;
    ``check_action_space`` verifies the choice.
    """
    if config.learner.algorithm == "auto":
        discrete = isinstance(action_space, spaces.Discrete)
        config = with_algorithm(config, agent_for("discrete" if discrete else "continuous", config.learner.method))
    if config.learner.normalise_observations == "auto":
        needed = not is_packages_environment(config.environment)
        learner = dataclasses.replace(config.learner, normalise_observations="on" if needed else "off")
        config = dataclasses.replace(config, learner=learner)
    return config


def with_algorithm(config: TaskConfig, algorithm: str) -> TaskConfig:
    """Set the algorithm, and its defaults for all settings that were not given."""
    plain, learner = LearnerConfig(), config.learner
    own = agent_settings(algorithm).learner_defaults
    free = {
        key: value
        for key, value in own.items()
        if key not in config.learner_given and getattr(learner, key) == getattr(plain, key)
    }
    changes = vars(msgspec.convert(free, LearnerConfig))
    learner = dataclasses.replace(learner, algorithm=algorithm, **{key: changes[key] for key in free})
    return dataclasses.replace(config, learner=learner)
