"""Settings of an agent that a test registers."""

from __future__ import annotations

from dataclasses import dataclass

from t4nmtd_dist.core.config import LearnerConfig
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.core.setting_types import Share


@dataclass(frozen=True)
class OwnConfig:
    """One share."""

    share: Share = 0.5
    most: float = 1.0


CONFIG = OwnConfig
ACTIONS = "discrete"
LEARNER_DEFAULTS = {"gamma": 0.7}
FORMER_KEYS = {"part": "use 'own.share'"}


def check(config: OwnConfig, learner: LearnerConfig) -> None:
    """The share must not be above ``most``."""
    if config.share > config.most:
        raise ConfigError(f"own.share = {config.share}: expected at most own.most = {config.most}")
