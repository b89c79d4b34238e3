"""T4NMTD: transition-centric reinforcement learning for non-Markovian tasks, distributed."""

from t4nmtd_dist.core.version import __version__

__all__ = ["__version__"]
