"""A run's counts, saved apart from checkpoints: every second, and in the final summary.

Damage to either file never stops a resume: invalid counts count as lost.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec

from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.runs.links import open_fresh
from t4nmtd_dist.wire.messages import LearnerStats

COUNTS_FILE = "counts.json"
LARGEST = 2**53

Warn = Callable[[str], None]


class Counts(msgspec.Struct):
    """The required content of ``counts.json``.

    Attributes:
        epochs: newest epochs by sub-task.
        evaluated: number of evaluations.
        totals: counts of each learner.
        outcome: how the run ended, if it has.
    """

    run_id: str
    elapsed_s: float
    epochs: dict[str, int]
    evaluated: int
    totals: dict[str, LearnerStats]
    outcome: str | None = None

    def __post_init__(self) -> None:
        whole = [self.evaluated, *self.epochs.values()]
        whole += [
            number
            for total in self.totals.values()
            for number in (total.interactions, total.attempts, total.successes, total.gradient_steps)
        ]
        if not (math.isfinite(self.elapsed_s) and 0 <= self.elapsed_s <= LARGEST):
            raise ValueError(f"elapsed_s = {self.elapsed_s}")
        if not all(0 <= number <= LARGEST for number in whole):
            raise ValueError("a count is out of range")


def write_counts(checkpoints: Path, counts: State) -> None:
    """Replace the saved counts; no fsync, so cheap every second."""
    fresh = checkpoints / f".{COUNTS_FILE}.new"
    with open_fresh(fresh) as file:
        file.write(json.dumps(counts))
    os.replace(fresh, checkpoints / COUNTS_FILE)


def read_counts(checkpoints: Path, warn: Warn = lambda _: None) -> State | None:
    """The saved counts; None if missing or unusable.

    Args:
        checkpoints: the run's checkpoint folder.
        warn: logs a damaged file.
    """
    path = checkpoints / COUNTS_FILE
    try:
        counts: State = json.loads(path.read_text(encoding="utf-8"))
        msgspec.convert(counts, Counts)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError, OverflowError) as error:
        warn(f"{path} is damaged ({described(error)}); going on without it")
        return None
    return counts


def counts_of_summary(summary: Mapping[str, Any], run_id: str) -> State | None:
    """The counts in a run's ``summary.json``; None if incomplete.

    Args:
        summary: the file's content.
        run_id: of the run.
    """
    fields = ("interactions", "attempts", "successes", "gradient_steps")
    try:
        learners = summary["learners"].items()
        counts = {
            "run_id": run_id,
            "elapsed_s": summary["wall_s"],
            "epochs": {},
            "evaluated": summary["evaluations"],
            "totals": {pid: {name: learner[name] for name in fields} for pid, learner in learners},
        }
        msgspec.convert(counts, Counts)
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError):
        return None
    return counts


def described(error: Exception) -> str:
    """A read error in one short line."""
    return " ".join(str(error).split())[:120] or type(error).__name__
