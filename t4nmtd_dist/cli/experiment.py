"""``t4nmtd experiment``: runs the paper's experiments, and makes their tables and figures."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from t4nmtd_dist.cli.plot import check_out, draw, save
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.core.registry import LAUNCHERS
from t4nmtd_dist.experiments.arms import check_tasks, experiment
from t4nmtd_dist.experiments.jobs import POLL_S, JobQueue, make_jobs
from t4nmtd_dist.experiments.results import by_arm, keep, read_results
from t4nmtd_dist.experiments.tables import run_table, tables
from t4nmtd_dist.process.signals import noted_signals

QUICK_TASKS, QUICK_SEEDS = ("task5", "task7"), (0, 1)
QUICK_FOLDER = "quick"
STOPPED = 130


def run_experiment(
    name: str,
    *,
    arms: Sequence[str],
    tasks: Sequence[str],
    seeds: str,
    jobs: int,
    launcher: str,
    quick: bool,
    root: Path,
) -> int:
    """Train what has not ended yet; the exit code: 0 all ended, 1 some failed, 130 stopped.

    Raises:
        ConfigError: for an unknown experiment, arm, task or launcher, or malformed seeds.
    """
    LAUNCHERS.check(launcher, "--launcher")
    if jobs < 1:
        raise ConfigError(f"--jobs {jobs}: expected at least 1")
    chosen = experiment(name)
    wanted_tasks = check_tasks(tasks or (QUICK_TASKS if quick else ()))
    wanted_seeds = QUICK_SEEDS if quick else parse_seeds(seeds)
    root = root / QUICK_FOLDER if quick else root
    planned = make_jobs(chosen, chosen.chosen(arms), wanted_tasks, wanted_seeds, root, quick=quick)
    queue = JobQueue(planned, parallel=jobs, launcher=launcher, tell=_say)
    stopped = _see_through(queue)
    _say(f"{queue.ended} of {queue.total} runs have ended; results in {root / name}")
    if stopped:
        _say("stopped; the same command goes on")
        return STOPPED
    return 1 if queue.failed else 0


def _see_through(queue: JobQueue) -> bool:
    """Run the queue to its end, with a progress bar; True if a signal stopped it."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with noted_signals() as interrupted, Progress(*columns, console=Console(stderr=True)) as progress:
        bar = progress.add_task("", total=queue.total)
        try:
            while queue.turn():
                names = ", ".join(job.name for job in queue.running)
                progress.update(bar, completed=queue.ended + len(queue.failed), description=names)
                if interrupted():
                    return True
                time.sleep(POLL_S)
            progress.update(bar, completed=queue.ended + len(queue.failed), description="")
        finally:
            queue.stop()
    return False


def print_tables(name: str, root: Path, kept: Path | None, *, runs: bool = False) -> int:
    """Print the tables of an experiment, or one with a row for every run; returns the exit code.

    Raises:
        ConfigError: for an unknown experiment.
        RunError: if there are no results, or they are damaged.
    """
    chosen = experiment(name)
    if kept is not None:
        _say(f"{keep(chosen, root, kept)} runs kept in {kept / name}")
    results = read_results(chosen, root)
    print(run_table(results) if runs else tables(chosen, results), end="")
    return 0


def plot_curves(name: str, root: Path, out: Path) -> int:
    """Draw one picture for every task into a folder, which is made if missing; returns the exit code.

    Raises:
        ConfigError: for an unknown experiment, or if a picture cannot be written.
        RunError: if there are no results, or they are damaged.
    """
    chosen = experiment(name)
    found = by_arm(read_results(chosen, root))
    for task in sorted({task for tasks in found.values() for task in tasks}):
        groups = {arm: [run.curves for run in tasks[task]] for arm, tasks in found.items() if task in tasks}
        file = _in_folder(out) / f"{name}-{task}.svg"
        check_out(file)
        save(draw(groups, ("interactions",), ("success", "length")), file)
        print(file)
    return 0


def _in_folder(folder: Path) -> Path:
    """The folder, made if it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out {folder}: {error.strerror}; give a folder that can be written") from None
    return folder


def parse_seeds(text: str) -> tuple[int, ...]:
    """The seeds in a text such as ``0-9`` or ``0,3,7``.

    Raises:
        ConfigError: if it is malformed.
    """
    found: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+)(?:-(\d+))?\s*", part)
        if match is None or (match[2] and int(match[2]) < int(match[1])):
            raise ConfigError(f"--seeds {text}: expected numbers and ranges, such as 0-9 or 0,3,7")
        found += range(int(match[1]), int(match[2] or match[1]) + 1)
    return tuple(dict.fromkeys(found))


def _say(text: str) -> None:
    print(f"t4nmtd: {text}", file=sys.stderr, flush=True)
