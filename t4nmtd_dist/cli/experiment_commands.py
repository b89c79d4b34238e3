"""The subcommands of ``t4nmtd experiment``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

Name = Annotated[Literal["tasks", "comparison", "decomposition", "intervention", "transfer"], tyro.conf.Positional]
ROOT = Path("runs/experiments")


@dataclass(frozen=True)
class Run:
    """Train all arms of an experiment over tasks and seeds; started again, it goes on where it was stopped."""

    name: Name
    """Which experiment."""
    arms: Annotated[list[str], tyro.conf.arg(aliases=["--methods"])] = field(default_factory=list)
    """Some of its arms; by default all."""
    tasks: list[str] = field(default_factory=list)
    """Some of the bundled tasks; by default all."""
    seeds: str = "0-9"
    """Seeds, such as 0-9 or 0,3,7."""
    jobs: int = 2
    """How many runs at a time."""
    launcher: str = "serial"
    """How each run is started: serial is one process per run, bit-reproducible."""
    quick: bool = False
    """Tasks 5 and 7, two seeds and a fiftieth of the caps, in a folder of its own; to see that everything works."""
    root: Path = ROOT
    """Folder of all experiments."""

    def run(self) -> int:
        """Train."""
        from t4nmtd_dist.cli.experiment import run_experiment

        return run_experiment(
            self.name,
            arms=self.arms,
            tasks=self.tasks,
            seeds=self.seeds,
            jobs=self.jobs,
            launcher=self.launcher,
            quick=self.quick,
            root=self.root,
        )


@dataclass(frozen=True)
class Table:
    """Print an experiment's tables in Markdown, from what its finished runs have written."""

    name: Name
    """Which experiment."""
    root: Path = ROOT
    """Folder of all experiments, or of kept results."""
    runs: bool = False
    """Print one row for every run instead."""
    keep: Path | None = None
    """Also copy the small files of all finished runs into this folder, from which table and plot read as well."""

    def run(self) -> int:
        """Print."""
        from t4nmtd_dist.cli.experiment import print_tables

        return print_tables(self.name, self.root, self.keep, runs=self.runs)


@dataclass(frozen=True)
class PlotCurves:
    """Draw an experiment's learning curves, one picture per task, with bootstrap bands."""

    name: Name
    """Which experiment."""
    root: Path = ROOT
    """Folder of all experiments, or of kept results."""
    out: Path = Path()
    """Folder of the pictures."""

    def run(self) -> int:
        """Draw."""
        from t4nmtd_dist.cli.experiment import plot_curves

        return plot_curves(self.name, self.root, self.out)


@dataclass(frozen=True)
class Experiment:
    """Repeat the paper's experiments: run, table, plot."""

    action: tyro.conf.OmitSubcommandPrefixes[Run | Table | Annotated[PlotCurves, tyro.conf.subcommand(name="plot")]]
    """What to do."""

    def run(self) -> int:
        """Run the chosen subcommand."""
        return self.action.run()
