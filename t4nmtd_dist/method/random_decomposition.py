"""T4NMTD with its transitions assigned to sub-tasks at random, from the run's seed (paper, experiment 2)."""

from __future__ import annotations

import dataclasses

from t4nmtd_dist.automata.deadline import Deadline
from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.method import t4nmtd
from t4nmtd_dist.method.decomposition import Decomposition

build = t4nmtd.build


def decompose(config: TaskConfig, dfa: DFA, *, seed: int, deadline: Deadline | None) -> Decomposition:
    """As many sub-tasks ``r1`` .. ``rn`` as ``t4nmtd`` has; see ``method.decomposition.decompose``.

    Raises:
        ConfigError: if ``decomposition.mode`` is ``literal``, which this method does not support.
    """
    settings = config.decomposition
    if settings.mode == "literal":
        raise ConfigError(
            'decomposition.mode = "literal": learner.method = "random" deals out the transitions of "objective"'
        )
    shuffled = dataclasses.replace(config, decomposition=dataclasses.replace(settings, mode="random"))
    return t4nmtd.decompose(shuffled, dfa, seed=seed, deadline=deadline)
