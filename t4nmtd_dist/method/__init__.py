"""The method: task decomposition, rewards, the high level and start states."""
