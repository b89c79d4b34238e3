"""The learner of methods whose roles share one environment: several networks, one replay buffer."""
