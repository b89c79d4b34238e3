"""The eight tasks of the paper as TOML files, and the loader that serves them and a user's own."""

from t4nmtd_dist.tasks.loader import is_bundled, load_task, task_names

__all__ = ["is_bundled", "load_task", "task_names"]
