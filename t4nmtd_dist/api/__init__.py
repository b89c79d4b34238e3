"""The Python API: tasks, training and results without command lines or task files."""
