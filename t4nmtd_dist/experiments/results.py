"""What an experiment's runs came to, read from their small files: run directories, or copies of these files."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.core.setting_sources import read_toml
from t4nmtd_dist.experiments.arms import Experiment
from t4nmtd_dist.experiments.final_evaluation import EVALUATION_FILE, read_evaluation
from t4nmtd_dist.experiments.jobs import ENDED
from t4nmtd_dist.runs.curves import RunCurves, read_run
from t4nmtd_dist.runs.directory import CONFIG_FILE, SUMMARY_FILE, read_summary
from t4nmtd_dist.statistics.censoring import times_or_never
from t4nmtd_dist.statistics.inputs import Floats
from t4nmtd_dist.statistics.scores import area_under_success

FOLDER = re.compile(r"(?P<task>.+)-s(?P<seed>\d+)")
KEPT = (SUMMARY_FILE, CONFIG_FILE, "versions.json", "metrics/evaluations.csv", EVALUATION_FILE)


@dataclass(frozen=True)
class Result:
    """One run that has ended.

    Attributes:
        interactions: before the first of the evaluations that solved the task; the cap of an unsolved run.
        cap: its budget in interactions.
        score: area under its success curve up to the cap, from 0 to 1.
        wall_s: duration in seconds.
        updates: gradient steps.
        own_share: share of the values asked from a peer for which the own critic stood in; nan if none was asked.
        length: mean length of 100 episodes of its policy from the reset in steps, nan if they were not played.
        success: success rate of these episodes, from 0 to 1 or nan.
        perturbed: the same from perturbed starts.
        curves: its evaluations.
    """

    arm: str
    task: str
    seed: int
    solved: bool
    converged: bool
    interactions: int
    cap: int
    score: float
    wall_s: float
    updates: int
    own_share: float
    length: float
    success: float
    perturbed: float
    curves: RunCurves


def read_results(experiment: Experiment, root: Path) -> list[Result]:
    """All runs of an experiment below ``root`` that have ended, by arm, task and seed.

    Raises:
        RunError: if there is none, or one is damaged.
    """
    arms = [arm.name for arm in experiment.arms]
    found = [
        _read(path.parent, arm, match["task"], int(match["seed"]))
        for arm in arms
        for path in sorted((root / experiment.name / arm).glob(f"*/{SUMMARY_FILE}"))
        if (match := FOLDER.fullmatch(path.parent.name)) and read_summary(path.parent).get("outcome") in ENDED
    ]
    if not found:
        raise RunError(
            f"no finished run of experiment {experiment.name} in {root / experiment.name}; "
            f"t4nmtd experiment run {experiment.name} makes them"
        )
    return sorted(found, key=lambda result: (arms.index(result.arm), result.task, result.seed))


def _read(folder: Path, arm: str, task: str, seed: int) -> Result:
    summary, config = read_summary(folder), read_toml(folder / CONFIG_FILE)
    curves = read_run(folder)
    cap = int(config["max_interactions"])
    solved = bool(summary["solved"]) and summary["interactions"] <= cap
    within = curves.columns["interactions"] < cap
    plain, perturbed = read_evaluation(folder) or ({}, {})
    asked = summary.get("intervention", {}).get("asked", 0)
    return Result(
        arm=arm,
        task=task,
        seed=seed,
        solved=solved,
        converged=bool(summary["converged"]),
        interactions=int(summary["interactions"]) if solved else cap,
        cap=cap,
        score=area_under_success(curves.columns["interactions"][within], curves.columns["success"][within], cap),
        wall_s=float(summary["wall_s"]),
        updates=int(summary.get("gradient_steps", 0)),
        own_share=summary["intervention"]["own_used"] / asked if asked else math.nan,
        length=float(plain.get("mean_length", math.nan)),
        success=float(plain.get("success_rate", math.nan)),
        perturbed=float(perturbed.get("success_rate", math.nan)),
        curves=curves,
    )


def keep(experiment: Experiment, root: Path, kept: Path) -> int:
    """Copy the small files of all runs that have ended from ``root`` to ``kept``; returns how many runs."""
    results = read_results(experiment, root)
    for result in results:
        source = result.curves.path
        target = kept / experiment.name / result.arm / source.name
        shutil.rmtree(target, ignore_errors=True)
        for name in KEPT:
            if (source / name).exists():
                (target / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source / name, target / name)
    return len(results)


def by_arm(results: Sequence[Result]) -> dict[str, dict[str, list[Result]]]:
    """Results by arm and task."""
    sorted_in: dict[str, dict[str, list[Result]]] = {}
    for result in results:
        sorted_in.setdefault(result.arm, {}).setdefault(result.task, []).append(result)
    return sorted_in


def times(results: Mapping[str, Sequence[Result]]) -> dict[str, Floats]:
    """Interactions to solve by task, infinity for an unsolved run."""
    return {
        task: times_or_never([run.interactions for run in runs], [run.solved for run in runs], _cap(runs))
        for task, runs in results.items()
    }


def scores(results: Mapping[str, Sequence[Result]]) -> dict[str, Floats]:
    """Areas under the success curves by task."""
    return {task: np.array([run.score for run in runs]) for task, runs in results.items()}


def caps(results: Mapping[str, Sequence[Result]]) -> dict[str, float]:
    """Budgets by task."""
    return {task: _cap(runs) for task, runs in results.items()}


def _cap(runs: Sequence[Result]) -> int:
    found = {run.cap for run in runs}
    if len(found) > 1:
        raise RunError(
            f"runs of {runs[0].arm} on {runs[0].task} had different budgets ({', '.join(map(str, sorted(found)))}): "
            "they cannot be summed up; keep them in different folders"
        )
    return found.pop()
