"""The eight tasks of the paper as TOML files, and the loader that serves them and a user's own."""

from t4nmtd_dist.tasks.loader import from_layers, is_bundled, is_packages_environment, load_task, task_file, task_names

__all__ = ["from_layers", "is_bundled", "is_packages_environment", "load_task", "task_file", "task_names"]
