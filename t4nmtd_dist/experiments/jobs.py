"""The runs of an experiment as jobs, each in a folder of its own, and a queue that starts and resumes them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.experiments.arms import CAPS, PAIRS, Arm, Experiment, applies
from t4nmtd_dist.experiments.final_evaluation import EVALUATION_FILE
from t4nmtd_dist.launch.command_lines import python_command
from t4nmtd_dist.runs.directory import CHECKPOINTS_FOLDER, SUMMARY_FILE, read_summary
from t4nmtd_dist.runs.resuming import IDENTITY_FILE
from t4nmtd_dist.runs.running import is_locked
from t4nmtd_dist.tasks import load_task

ENDED = ("solved", "budget spent")
POLL_S = 0.2
END_S = 60.0
LOG_FILE = "train.log"
CHECKPOINT_EVERY_S = "60"
QUICK_CAP_SHARE = 0.02
QUICK_SETTINGS = ("evaluation.every=1000",)


@dataclass(frozen=True)
class Job:
    """One run of an experiment.

    Attributes:
        cap: budget in interactions.
        folder: its run directory, named after experiment, arm, task and seed.
        settings: ``key=value`` for ``--set``.
        source: run whose networks are transferred; the job waits for it.
        evaluates: whether its policy plays further episodes at the end (``final_evaluation``).
    """

    arm: Arm
    task: str
    seed: int
    cap: int
    folder: Path
    settings: tuple[str, ...] = ()
    source: Path | None = None
    evaluates: bool = True

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.arm.name} {self.task} seed {self.seed}"

    @property
    def trained(self) -> bool:
        """Whether it was solved or spent its budget."""
        return outcome(self.folder) in ENDED

    @property
    def ended(self) -> bool:
        """Whether it was trained and, if wanted, its policy evaluated."""
        return self.trained and (not self.evaluates or (self.folder / EVALUATION_FILE).exists())

    def command(self, launcher: str) -> list[str]:
        """Begin the run, resume it from its checkpoints, or evaluate its policy."""
        if self.trained:
            return [sys.executable, "-P", "-m", "t4nmtd_dist.experiments.final_evaluation", str(self.folder)]
        command = [*python_command("t4nmtd"), "train", "--no-dashboard", "--launcher", launcher]
        command += ["--parent", str(os.getpid()), "--checkpoint-every", CHECKPOINT_EVERY_S]
        if (self.folder / CHECKPOINTS_FOLDER / IDENTITY_FILE).exists():
            return [*command, "--resume", str(self.folder)]
        command += ["--task", self.task, "--seed", str(self.seed), "--max-interactions", str(self.cap), "--restart"]
        command += ["--method", self.arm.method] if self.arm.method else []
        command += ["--preset", self.arm.preset] if self.arm.preset else []
        command += [part for setting in self.settings for part in ("--set", setting)]
        command += ["--transfer-from", str(self.source)] if self.source is not None else []
        return [*command, "--run-dir", str(self.folder), "--tensorboard", "off"]


def outcome(folder: Path) -> str:
    """How the run in a folder ended; "" if it has not, or there is none."""
    try:
        return str(read_summary(folder)["outcome"]) if (folder / SUMMARY_FILE).exists() else ""
    except (RunError, KeyError):
        return ""


def make_jobs(
    experiment: Experiment,
    arms: Sequence[Arm],
    tasks: Sequence[str],
    seeds: Sequence[int],
    root: Path,
    *,
    quick: bool = False,
) -> list[Job]:
    """All jobs of an experiment, seed by seed, so that an unfinished queue has few seeds of everything.

    An arm whose networks come from another task needs that task's run, which is added.

    Args:
        experiment: names their folder.
        arms: of the experiment.
        tasks: names of bundled tasks.
        seeds: of the runs; arms are paired by them.
        root: of all experiments.
        quick: with a fraction of the caps, frequent evaluations, and none at the end.
    """
    home = root / experiment.name
    wanted = {(arm, task): None for task in tasks for arm in arms if applies(arm, load_task(task))}
    by_name = {arm.name: arm for arm in experiment.arms}
    sources = {(by_name[arm.source], PAIRS[task]): None for arm, task in wanted if arm.source}
    return [
        Job(
            arm,
            task,
            seed,
            round(CAPS[task] * (QUICK_CAP_SHARE if quick else 1.0)),
            home / arm.name / f"{task}-s{seed}",
            (*arm.settings, *experiment.by_task.get(task, ()), *(QUICK_SETTINGS if quick else ())),
            home / arm.source / f"{PAIRS[task]}-s{seed}" if arm.source else None,
            not quick,
        )
        for seed in seeds
        for arm, task in sources | wanted
    ]


@dataclass
class _Running:
    job: Job
    process: subprocess.Popen[bytes]
    evaluates: bool


class JobQueue:
    """Runs jobs, several at a time.

    The loop it is meant for::

        queue = JobQueue(jobs, parallel=2, launcher="serial")
        while queue.turn():
            show(queue.ended, queue.failed)

    Args:
        jobs: those that have ended are left out.
        parallel: how many run at a time.
        launcher: of every run.
        tell: hears of every end.

    Attributes:
        failed: jobs that ended without an outcome, with the reason.
    """

    def __init__(
        self, jobs: Sequence[Job], *, parallel: int, launcher: str = "serial", tell: Callable[[str], None] = print
    ) -> None:
        self._waiting = [job for job in jobs if not job.ended]
        self._parallel, self._launcher, self._tell = parallel, launcher, tell
        self._running: list[_Running] = []
        self.total, self.ended = len(jobs), len(jobs) - len(self._waiting)
        self.failed: dict[str, str] = {}

    @property
    def running(self) -> list[Job]:
        """The jobs under way."""
        return [running.job for running in self._running]

    def turn(self) -> bool:
        """Start what there is room for, and take note of what has ended; False once nothing is left."""
        for running in list(self._running):
            if running.process.poll() is not None:
                self._running.remove(running)
                self._take_end(running)
        while len(self._running) < self._parallel and (job := self._next()) is not None:
            self._start(job)
        return bool(self._running)

    def _next(self) -> Job | None:
        """The first job that waits for no other; those whose source failed are given up."""
        for job in list(self._waiting):
            source = "solved" if job.source is None else outcome(job.source)
            if source == "solved":
                self._waiting.remove(job)
                return job
            unfinished = [other for other in [*self._waiting, *self.running] if other.folder == job.source]
            if not unfinished:
                self._waiting.remove(job)
                self._fail(job, f"the run that its networks would come from was not solved: {job.source}")
        return None

    def _fail(self, job: Job, why: str) -> None:
        self.failed[job.name] = why
        self._tell(f"{job.name}: {why}")

    def _start(self, job: Job) -> None:
        if is_locked(job.folder):
            self._fail(job, f"another process trains in {job.folder}")
            return
        job.folder.parent.mkdir(parents=True, exist_ok=True)
        log = job.folder.parent / f"{job.folder.name}.{LOG_FILE}"
        evaluates = job.trained
        with log.open("ab") as file:
            environment = {**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
            process = subprocess.Popen(
                job.command(self._launcher),
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                env=environment,
                start_new_session=True,
            )
        self._running.append(_Running(job, process, evaluates))

    def _take_end(self, running: _Running) -> None:
        job = running.job
        if job.ended:
            self.ended += 1
            summary = read_summary(job.folder)
            self._tell(f"{job.name}: {summary['outcome']} after {summary['interactions_total']:,} interactions")
            return
        if job.trained and not running.evaluates:
            self._start(job)
            return
        log = job.folder.parent / f"{job.folder.name}.{LOG_FILE}"
        last = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:]
        self._fail(job, f"exit code {running.process.returncode}; {' '.join(last)} ({log})")

    def stop(self) -> None:
        """Ask all runs to write a checkpoint and end; kill those that do not within a minute."""
        for running in self._running:
            running.process.send_signal(signal.SIGTERM)
        deadline = time.monotonic() + END_S
        for running in self._running:
            try:
                running.process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                running.process.kill()
                running.process.wait()
        self._running.clear()
