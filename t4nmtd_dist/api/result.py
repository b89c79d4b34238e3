"""The result of a training run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.policy import load
from t4nmtd_dist.runs.curves import read_run
from t4nmtd_dist.runs.directory import read_summary
from t4nmtd_dist.runs.report import outcome_text

if TYPE_CHECKING:
    from t4nmtd_dist.policy import GlobalPolicy


@dataclass(frozen=True)
class TrainingResult:
    """The outcome of a training run and its directory.

    Attributes:
        run_dir: the run directory, for ``t4nmtd evaluate``, ``record``, ``plot`` and ``train --resume``.
        summary: the contents of its ``summary.json``.
    """

    run_dir: Path
    summary: Mapping[str, Any]

    @classmethod
    def of(cls, run_dir: Path) -> TrainingResult:
        """The result of a finished run.

        Raises:
            RunError: if it has no summary.
        """
        return cls(run_dir, read_summary(run_dir))

    @property
    def outcome(self) -> str:
        """``"solved"``, ``"budget spent"`` or ``"stopped"``."""
        return str(self.summary["outcome"])

    @property
    def solved(self) -> bool:
        """Whether enough consecutive evaluations succeeded."""
        return bool(self.summary["solved"])

    @property
    def interactions(self) -> int:
        """Environment steps before the first of the solving evaluations; of the whole run if unsolved."""
        return int(self.summary["interactions"])

    @cached_property
    def policy(self) -> GlobalPolicy:
        """The policy of the best evaluation.

        Raises:
            PolicyError: if the run ended before its first evaluation.
        """
        return load(self.run_dir)

    @cached_property
    def curves(self) -> Mapping[str, NDArray[np.float64]]:
        """The evaluations in order, [n] each: ``interactions``, ``time`` (s), ``success``, ``length``, ``return``.

        Raises:
            RunError: if the run ended before its first evaluation.
        """
        return read_run(self.run_dir).columns

    def __str__(self) -> str:
        return outcome_text(dict(self.summary), self.run_dir)
