"""Train tasks over seeds, evaluate the policies, and print the table of docs/results.md.

    python benchmarks/train_tasks.py --tasks task7 task8 --seeds 0 1 2 3 4

Every run is a `t4nmtd train` of its own; one that is already in ``--runs`` is not repeated. The small files behind
the table (summary, settings, evaluations) are copied to benchmarks/results/TASK-sSEED.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
KEPT = ("summary.json", "config.toml", "versions.json", "metrics/evaluations.csv")
EPISODES = 100
PERTURB = 20


def train(task: str, seed: int, run: Path, flags: list[str]) -> dict[str, Any]:
    """Train one task with one seed, unless that was done before; its summary."""
    if not (run / "summary.json").exists():
        command = ["t4nmtd", "train", "--task", task, "--seed", str(seed), "--run-dir", str(run), "--no-dashboard"]
        subprocess.run([*_program(command), *flags], check=False)
    summary: dict[str, Any] = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    return summary


def evaluate(run: Path, perturb: int) -> dict[str, Any]:
    """Evaluate the exported policy of a run."""
    command = ["t4nmtd", "evaluate", str(run), "--episodes", str(EPISODES), "--perturb", str(perturb), "--json"]
    output = subprocess.run(_program(command), check=True, capture_output=True, text=True).stdout
    found: dict[str, Any] = json.loads(output)
    return found


def _program(command: list[str]) -> list[str]:
    return [str(Path(sys.executable).with_name(command[0])), *command[1:]]


def keep(run: Path, name: str, extra: dict[str, Any]) -> None:
    """Copy the small files of a run to benchmarks/results."""
    home = RESULTS / name
    home.mkdir(parents=True, exist_ok=True)
    for file in KEPT:
        shutil.copy(run / file, home / Path(file).name)
    (home / "evaluation.json").write_text(json.dumps(extra, indent=1), encoding="utf-8")


def row(task: str, seed: int, summary: dict[str, Any], plain: dict[str, Any], perturbed: dict[str, Any]) -> str:
    """One line of the table."""
    asked = summary["intervention"]["asked"] or 1
    return (
        f"| {task} | {seed} | {'yes' if summary['solved'] else 'no'} | {summary['interactions']:,} "
        f"| {summary['wall_s']:.0f} | {summary['gradient_steps']:,} | {plain['mean_length']:.0f} "
        f"| {plain['success_rate']:.0%} | {perturbed['success_rate']:.0%} "
        f"| {summary['intervention']['own_used'] / asked:.1%} |"
    )


def main() -> None:
    """Run what was asked for and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["task7", "task8"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--runs", type=Path, default=Path("runs/benchmark"))
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    arguments = parser.parse_args()
    flags = [part for flag in arguments.set for part in ("--set", flag)]
    lines = [
        "| task | seed | solved | interactions | wall s | updates | length | success | perturbed | own critic used |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for task in arguments.tasks:
        for seed in arguments.seeds:
            run = arguments.runs / f"{task}-s{seed}"
            summary = train(task, seed, run, flags)
            plain, perturbed = evaluate(run, 0), evaluate(run, PERTURB)
            keep(run, f"{task}-s{seed}", {"plain": plain, "perturbed": perturbed, "perturb": PERTURB})
            lines.append(row(task, seed, summary, plain, perturbed))
            print(lines[-1], flush=True)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
