"""Options that several commands share."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from t4nmtd_dist.config import TaskConfig


@dataclass(frozen=True)
class RunOptions:
    """What a training run takes, however it is started."""

    task: str
    """Name of a task (task1 .. task8), or the path of a task file of your own."""
    seed: int = 0
    """Seed of networks, exploration and worlds."""
    run_dir: Path | None = None
    """Folder of the run; by default runs/TASK/UTC-sSEED."""
    restart: bool = False
    """Delete the run that --run-dir holds and begin anew."""
    max_interactions: int | None = None
    """Budget of environment steps of all learners together."""
    config: Annotated[list[Path], tyro.conf.UseAppendAction] = field(default_factory=list)
    """TOML file laid over the task file; may be repeated."""
    set: Annotated[list[str], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KEY=VALUE")] = field(
        default_factory=list
    )
    """One setting, such as learner.gamma=0.98; may be repeated."""
    translator: Literal["auto", "mona", "python"] = "auto"
    """How the formula becomes an automaton; auto takes MONA if it is installed."""

    def load(self) -> TaskConfig:
        """The task's settings with everything laid over.

        Raises:
            ConfigError: see ``load_task``.
        """
        from t4nmtd_dist.tasks import load_task

        flags = list(self.set)
        if self.max_interactions is not None:
            flags.append(f"max_interactions={self.max_interactions}")
        return load_task(self.task, configs=self.config, flags=flags)

    def directory(self, task: str) -> Path:
        """The run directory to use."""
        from t4nmtd_dist.runs.directory import default_run_directory

        return self.run_dir if self.run_dir is not None else default_run_directory(task, self.seed)
