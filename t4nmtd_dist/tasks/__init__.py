"""The paper's eight tasks as TOML files, and the loader for them and for user tasks."""

from t4nmtd_dist.tasks.loader import from_layers, is_bundled, is_packages_environment, load_task, task_file, task_names

__all__ = ["from_layers", "is_bundled", "is_packages_environment", "load_task", "task_file", "task_names"]
