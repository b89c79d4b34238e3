"""Hand-written kernels of soft actor-critic for the CPU."""
