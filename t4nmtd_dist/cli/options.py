"""Shared command-line options."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from t4nmtd_dist.runs.options import RunOptions


@dataclass(frozen=True)
class RunFlags(RunOptions):
    """The options of a run as command-line flags; some of them may be repeated."""

    config: Annotated[list[Path], tyro.conf.UseAppendAction] = field(default_factory=list)
    """TOML file laid over the task file; may be repeated."""
    set: Annotated[list[str], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KEY=VALUE")] = field(
        default_factory=list
    )
    """One setting, such as learner.gamma=0.98; may be repeated."""
