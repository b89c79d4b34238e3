"""What is learned where: decomposition, rewards, the high level and start states."""
