"""T4NMTD: transition-centric reinforcement learning for non-Markovian tasks, distributed.

``Task``, ``train`` and ``load`` are the public API, imported on first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from t4nmtd_dist.core.version import __version__

if TYPE_CHECKING:
    from t4nmtd_dist.api.result import TrainingResult
    from t4nmtd_dist.api.task import Task
    from t4nmtd_dist.api.training import train
    from t4nmtd_dist.policy import GlobalPolicy, load

__all__ = ["GlobalPolicy", "Task", "TrainingResult", "__version__", "load", "train"]

_WHERE = {
    "GlobalPolicy": "policy",
    "Task": "api.task",
    "TrainingResult": "api.result",
    "load": "policy",
    "train": "api.training",
}


def __getattr__(name: str) -> object:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_WHERE[name]}"), name)
