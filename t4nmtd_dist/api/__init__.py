"""The Python API: tasks, training and results."""
