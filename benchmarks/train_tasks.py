"""Train tasks over seeds, evaluate the policies, keep the small files, and print the table of docs/results.md.

    python benchmarks/train_tasks.py --tasks task7 task8 --seeds 0 1 2 3 4
    python benchmarks/train_tasks.py --tasks task7 --seeds 0 1 --keep    # no training, keep finished runs
    python benchmarks/train_tasks.py --table                             # everything kept, from benchmarks/results

Every run is a separate `t4nmtd train`; finished runs in ``--runs`` are skipped, stopped ones resumed. The files behind
the table (summary, settings, evaluations, at most 200 rows of each learner's metrics) are copied to
benchmarks/results/TASK-sSEED, the policy of each task's lowest good seed to benchmarks/policies/TASK.

Means of interactions, wall-clock time, updates and length cover the solved runs, all others all runs. "of paper's" is
the share of the paper's interactions.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from t4nmtd_dist.policy.export import ACTORS_FILE, POLICY_FILE

HOME = Path(__file__).parent
KEPT = ("summary.json", "config.toml", "versions.json", "metrics/evaluations.csv")
MOST_ROWS = 200
MOST_POLICY_BYTES = 2_000_000
LEAST_SUCCESS = 0.97  # of a kept policy
EPISODES = 100
PERTURB = 20
COLUMNS = (
    "task", "seed", "solved", "interactions", "of paper's", "wall s", "updates", "length", "success", "perturbed",
    "own critic used",
)  # fmt: skip
PAPER = {
    "task1": 0.8e6, "task2": 1.5e6, "task3": 1.3e6, "task4": 1.5e6,
    "task5": 1.1e6, "task6": 2.5e6, "task7": 4.4e6, "task8": 4.9e6,
}  # fmt: skip
"""Mean interactions that the paper reports."""


# Runs


def train(task: str, seed: int, run: Path, settings: Sequence[str]) -> None:
    """Train one task with one seed, or resume it."""
    command = training_command(task, seed, run, settings)
    if command:
        subprocess.run(_program(command), check=False)


def training_command(task: str, seed: int, run: Path, settings: Sequence[str]) -> list[str]:
    """The command that starts a run with ``settings`` (``key=value``) or resumes it under its own.

    Empty if the run has ended.
    """
    if not run.exists():
        command = ["t4nmtd", "train", "--task", task, "--seed", str(seed), "--run-dir", str(run), "--no-dashboard"]
        return [*command, *(part for setting in settings for part in ("--set", setting))]
    summary = run / "summary.json"
    outcome = json.loads(summary.read_text(encoding="utf-8"))["outcome"] if summary.exists() else None
    return ["t4nmtd", "train", "--resume", str(run), "--no-dashboard"] if outcome in (None, "stopped") else []


def evaluate(run: Path, perturb: int) -> dict[str, Any]:
    """Evaluate the exported policy of a run."""
    command = ["t4nmtd", "evaluate", str(run), "--episodes", str(EPISODES), "--perturb", str(perturb), "--json"]
    output = subprocess.run(_program(command), check=True, capture_output=True, text=True).stdout
    found: dict[str, Any] = json.loads(output)
    return found


def _program(command: list[str]) -> list[str]:
    return [str(Path(sys.executable).with_name(command[0])), *command[1:]]


# What is kept


def keep(run: Path, name: str, evaluation: dict[str, Any], home: Path = HOME) -> None:
    """Copy a run's small files to ``home``/results/``name``, replacing what is there."""
    kept = home / "results" / name
    shutil.rmtree(kept, ignore_errors=True)
    (kept / "metrics").mkdir(parents=True)
    for file in KEPT:
        shutil.copyfile(run / file, kept / Path(file).name)
    for path in sorted((run / "metrics").glob("*.csv")):
        if path.name != "evaluations.csv":
            lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
            (kept / "metrics" / path.name).write_text("".join(thinned(lines)), encoding="utf-8")
    (kept / "evaluation.json").write_text(json.dumps(evaluation, indent=1), encoding="utf-8")


def thinned(lines: Sequence[str], most: int = MOST_ROWS) -> list[str]:
    """The header and at most ``most`` (2 or more) evenly spaced rows, including first and last."""
    header, rows = lines[:1], lines[1:]
    if len(rows) > most:
        rows = [rows[i * (len(rows) - 1) // (most - 1)] for i in range(most)]
    return [*header, *rows]


def keep_policy(run: Path, task: str, seed: int, home: Path = HOME) -> None:
    """Copy a run's policy to ``home``/policies if its seed is the task's lowest good one.

    Solving a run may be luck, so a good policy must also succeed in 97 of 100 further episodes.
    """
    good = (row.seed for row in read_rows(home) if row.task == task and row.solved and row.success >= LEAST_SUCCESS)
    if seed != min(good, default=None):
        return
    files = [run / "policy" / name for name in (POLICY_FILE, ACTORS_FILE)]
    size = sum(path.stat().st_size for path in files)
    if size > MOST_POLICY_BYTES:
        _say(f"the policy of {run.name} has {size:,} bytes, more than {MOST_POLICY_BYTES:,}: it is not kept")
        return
    kept = home / "policies" / task
    shutil.rmtree(kept, ignore_errors=True)
    kept.mkdir(parents=True)
    for path in files:
        shutil.copyfile(path, kept / path.name)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


# The table


@dataclass(frozen=True)
class Row:
    """A run's row in the table; success and shares from 0 to 1."""

    task: str
    seed: int
    solved: bool
    interactions: int
    wall_s: float
    updates: int
    length: float
    success: float
    perturbed: float
    own_share: float

    def line(self) -> str:
        """The run's line of the table."""
        return _line(self.task, str(self.seed), "yes" if self.solved else "no", [self], [self])


def read_rows(home: Path = HOME) -> list[Row]:
    """All runs in ``home``/results, by task and seed."""
    rows = [_read_row(path.parent) for path in (home / "results").glob("*/summary.json")]
    return sorted(rows, key=lambda row: (row.task, row.seed))


def _read_row(kept: Path) -> Row:
    summary = json.loads((kept / "summary.json").read_text(encoding="utf-8"))
    evaluation = json.loads((kept / "evaluation.json").read_text(encoding="utf-8"))
    asked = summary["intervention"]["asked"] or 1
    return Row(
        summary["task"],
        summary["seed"],
        summary["solved"],
        summary["interactions"],
        summary["wall_s"],
        summary["gradient_steps"],
        evaluation["plain"]["mean_length"],
        evaluation["plain"]["success_rate"],
        evaluation["perturbed"]["success_rate"],
        summary["intervention"]["own_used"] / asked,
    )


def table(rows: Sequence[Row]) -> Iterator[str]:
    """The lines of the table: every task's runs, then their means."""
    yield "| " + " | ".join(COLUMNS) + " |"
    yield "|---" * len(COLUMNS) + "|"
    for task in sorted({row.task for row in rows}):
        runs = [row for row in rows if row.task == task]
        solved = [row for row in runs if row.solved]
        yield from (row.line() for row in runs)
        yield _line(task, "mean", f"{len(solved)} of {len(runs)}", solved, runs)


def _line(task: str, seed: str, solved: str, reached: Sequence[Row], runs: Sequence[Row]) -> str:
    """A line of means: ``reached`` for costs and length, ``runs`` for the rest."""
    cells = [task, seed, solved, "-", "-", "-", "-", "-"]
    if reached:
        interactions = statistics.mean(row.interactions for row in reached)
        cells[3:] = [
            f"{interactions:,.0f}",
            f"{interactions / PAPER[task]:.1%}" if task in PAPER else "-",
            f"{statistics.mean(row.wall_s for row in reached):.0f}",
            f"{statistics.mean(row.updates for row in reached):,.0f}",
            f"{statistics.mean(row.length for row in reached):.0f}",
        ]
    cells += [
        f"{statistics.mean(row.success for row in runs):.0%}",
        f"{statistics.mean(row.perturbed for row in runs):.0%}",
        f"{statistics.mean(row.own_share for row in runs):.1%}",
    ]
    return "| " + " | ".join(cells) + " |"


def _train_and_keep(task: str, seed: int, arguments: argparse.Namespace) -> None:
    run: Path = arguments.runs / f"{task}-s{seed}"
    if not arguments.keep:
        train(task, seed, run, arguments.set)
    if not (run / "summary.json").exists() or not (run / "policy").is_dir():
        _say(f"{run.name}: no summary or no policy, so nothing is kept")
        return
    plain, perturbed = evaluate(run, 0), evaluate(run, PERTURB)
    keep(run, run.name, {"plain": plain, "perturbed": perturbed, "perturb": PERTURB})
    keep_policy(run, task, seed)
    _say(_read_row(HOME / "results" / run.name).line())


def main() -> None:
    """Parse the arguments, train and keep, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["task7", "task8"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--runs", type=Path, default=Path("runs/benchmark"))
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--keep", action="store_true", help="train nothing, keep the finished ones of --runs")
    parser.add_argument("--table", action="store_true", help="do nothing but print the table of all that is kept")
    arguments = parser.parse_args()
    rows = read_rows()
    if not arguments.table:
        for task in arguments.tasks:
            for seed in arguments.seeds:
                _train_and_keep(task, seed, arguments)
        wanted = {(task, seed) for task in arguments.tasks for seed in arguments.seeds}
        rows = [row for row in read_rows() if (row.task, row.seed) in wanted]
    print("\n".join(table(rows)))


if __name__ == "__main__":
    main()
