"""Learning curves: evaluations of several runs on a common grid, as mean and confidence interval.

A curve is a step function: an evaluation holds until the next. Runs are compared where all have values. A solved run
keeps its last values (last value carried forward). The mean ends with the first run that ended unsolved.
"""

from __future__ import annotations

import csv
import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.runs.directory import CONFIG_FILE, SUMMARY_FILE
from t4nmtd_dist.statistics.bootstrap import mean_band

Floats = NDArray[np.float64]
Axis = Literal["interactions", "time"]
Metric = Literal["success", "length", "return"]

COLUMNS = {
    "interactions": "interactions",
    "time": "elapsed_s",
    "success": "success_rate",
    "length": "mean_length",
    "return": "mean_return",
}
EVALUATIONS = ("metrics/evaluations.csv", "evaluations.csv")
# Of the bootstrap; a picture needs no more draws.
SEED, DRAWS = 0, 2_000


@dataclass(frozen=True)
class RunCurves:
    """The evaluations of one run, in order.

    Attributes:
        solved: whether the run ended because the task was solved.
        columns: by axis or metric, float64 [n] each: environment steps, seconds, success from 0 to 1, environment
            steps of an episode, validation reward.
    """

    path: Path
    task: str
    solved: bool
    columns: Mapping[str, Floats]


@dataclass(frozen=True)
class MeanCurve:
    """A step function with an interval around it; all arrays are float64 [n].

    Attributes:
        x: where the function changes, ascending.
        mean: over the runs, from x to the next x.
        low: lower end of the mean's confidence interval; the mean itself for one run.
        high: upper end.
        runs: number of runs.
    """

    x: Floats
    mean: Floats
    low: Floats
    high: Floats
    runs: int


def read_run(path: Path) -> RunCurves:
    """Read a run directory, or a reduced copy as in ``benchmarks/results``; the run may be active.

    Omits rows that a resumed run repeated.

    Raises:
        RunError: if the folder holds no run or no evaluation, or a file is damaged.
    """
    found = next((path / name for name in EVALUATIONS if (path / name).is_file()), None)
    if found is None:
        raise RunError(
            f"no evaluations in {path}: expected a run directory with {EVALUATIONS[0]}, which a run has after its "
            f"first evaluation{_runs_inside(path)}"
        )
    task, solved = _about(path)
    columns = _read_columns(found)
    kept = _not_repeated(columns["interactions"])
    columns = {name: column[kept] for name, column in columns.items()}
    if (np.diff(columns["time"]) < 0).any():
        raise RunError(f"{found} is damaged: elapsed_s falls while interactions rise")
    return RunCurves(path, task, solved, columns)


def _runs_inside(path: Path) -> str:
    inside = sorted(entry.name for entry in path.glob("*") if any((entry / name).is_file() for name in EVALUATIONS))
    return f"; it holds runs, so name them: {path}/{inside[0]} ..." if inside else ""


def _about(path: Path) -> tuple[str, bool]:
    """The task's name, and whether the run solved it."""
    try:
        if (path / SUMMARY_FILE).exists():
            summary: dict[str, Any] = json.loads((path / SUMMARY_FILE).read_text(encoding="utf-8"))
            return str(summary["task"]), bool(summary["solved"])
        return str(tomllib.loads((path / CONFIG_FILE).read_text(encoding="utf-8"))["name"]), False
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = f"no {error} in it" if isinstance(error, KeyError) else error
        raise RunError(f"cannot read {SUMMARY_FILE} or {CONFIG_FILE} of the run {path}: {reason}") from None


def _read_columns(path: Path) -> dict[str, Floats]:
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file, restval=""))
        columns = {name: np.array([float(row[title]) for row in rows]) for name, title in COLUMNS.items()}
    except KeyError as error:
        raise RunError(f"{path} has no column {error}") from None
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise RunError(f"{path} is damaged: {error}") from None
    if not rows:
        raise RunError(f"{path} has no evaluation yet")
    if not all(np.isfinite(columns[axis]).all() for axis in ("interactions", "time")):
        raise RunError(f"{path} is damaged: interactions and elapsed_s must be finite numbers")
    return columns


def _not_repeated(x: Floats) -> NDArray[np.bool_]:
    """Rows that no later row precedes in x [n]."""
    later = np.minimum.accumulate(np.append(x[1:], np.inf)[::-1])[::-1]
    return np.asarray(x < later)


def step_values(x: Floats, y: Floats, grid: Floats) -> Floats:
    """The step function through (x, y) on a grid, float64 [m]: the last y at or before each point, NaN before all.

    Args:
        x: ascending [n].
        y: [n].
        grid: [m].
    """
    before = np.searchsorted(x, grid, side="right")
    return np.append(np.nan, y)[before]


def common_grid(runs: Sequence[RunCurves], axis: Axis) -> Floats:
    """All points where a run's step function changes, float64 [m], within the range common to all runs.

    The range begins at the latest first evaluation. It ends with the longest run, or with the first run that ended
    unsolved.

    Raises:
        RunError: if the range is empty.
    """
    begin = max(float(run.columns[axis][0]) for run in runs)
    end = max(float(run.columns[axis][-1]) for run in runs)
    unsolved = [run for run in runs if not run.solved]
    if unsolved:
        first = min(unsolved, key=lambda run: float(run.columns[axis][-1]))
        end = float(first.columns[axis][-1])
        if end < begin:
            raise RunError(
                f"the runs have no stretch in common: {first.path} ends unsolved before another's first evaluation; "
                "leave it out, or give it a --label of its own"
            )
    points: Floats = np.unique(np.concatenate([run.columns[axis] for run in runs]))
    return points[(points >= begin) & (points <= end)]


def mean_curve(runs: Sequence[RunCurves], axis: Axis, metric: Metric) -> MeanCurve:
    """Mean over runs with its 95 % confidence interval, by percentile bootstrap of the runs.

    The interval lies between the lowest and the highest run, so that of a success rate within 0 and 1. The same runs
    always have the same interval. Of few runs it is too narrow, see ``t4nmtd_dist.statistics.bootstrap``.

    Raises:
        RunError: if the runs have no common range.
    """
    grid = common_grid(runs, axis)
    values = np.stack([step_values(run.columns[axis], run.columns[metric], grid) for run in runs])
    band = mean_band(grid, values, np.random.default_rng(SEED), draws=DRAWS)
    return MeanCurve(grid, band.value, band.low, band.high, len(runs))
