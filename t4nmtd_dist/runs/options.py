"""Options of a training run, from a command line or a program."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from t4nmtd_dist.runs.event_files import TensorBoard


@dataclass(frozen=True)
class RunOptions:
    """What a training run takes, however it is started."""

    task: str = ""
    """Name of a task (task1 .. task8), or the path of a task file of your own; not needed with --resume."""
    seed: int | None = None
    """Seed of networks, exploration and environments; by default 0."""
    resume: Path | None = None
    """Go on with the stopped run in this folder, under its own settings; --max-interactions may give it more."""
    transfer_from: Path | None = None
    """Begin the sub-tasks that a solved run has, too, with its networks (all else begins anew); a run or a policy."""
    trust: bool = False
    """Import the code that the run to resume names, whoever made it; without this, only what you have run before."""
    checkpoint_every: float = 300.0
    """Seconds between two checkpoints, from which --resume goes on; another is written when the run is stopped."""
    run_dir: Path | None = None
    """Folder of the run; by default runs/TASK/UTC-sSEED."""
    restart: bool = False
    """Delete the run that --run-dir holds and begin anew."""
    max_interactions: int | None = None
    """Budget of environment steps of all learners together."""
    config: list[Path] = field(default_factory=list)
    """TOML file laid over the task file; may be repeated."""
    method: str = ""
    """Method that learns, such as crm, with an agent that it can use; `t4nmtd tasks --methods` lists them."""
    preset: str = ""
    """Settings laid over the task file by name; `paper` is the method as published."""
    set: list[str] = field(default_factory=list)
    """One setting, such as learner.gamma=0.98; may be repeated."""
    translator: Literal["auto", "mona", "python"] = "auto"
    """How the formula becomes an automaton; auto takes MONA if it is installed."""
    tensorboard: TensorBoard = "auto"
    """Curves for TensorBoard in the run's folder `tensorboard`; auto writes them if that package is installed."""
