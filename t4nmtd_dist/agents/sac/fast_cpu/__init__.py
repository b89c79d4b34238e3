"""Hand-written CPU kernels for soft actor-critic."""
