"""T4NMTD: transition-centric reinforcement learning for non-Markovian tasks, distributed."""

__version__ = "0.1.0"
