"""``t4nmtd train``: the newcomer's door. Starts everything on this machine and shows the dashboard."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from t4nmtd_dist.cli.death_notices import DeathNotices
from t4nmtd_dist.cli.options import RunOptions
from t4nmtd_dist.cli.plan import RunPlan, plan_run
from t4nmtd_dist.core.devices import Device, check_device
from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.environments.cautions import cautions
from t4nmtd_dist.environments.preparation import prepared
from t4nmtd_dist.launch.local import LocalProcesses, dealt
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.process.signals import hear_ends
from t4nmtd_dist.runs.directory import RunDirectory, read_summary
from t4nmtd_dist.runs.report import outcome_text
from t4nmtd_dist.runs.resuming import write_identity
from t4nmtd_dist.wire.auth.keys import ClientKeys, load_client

SOLVED, BUDGET_SPENT, STOPPED = 0, 3, 130
LAST_STATE_S = 15.0
RESULT_S = 90.0  # in which a coordinator that finds no room for its result gives up


class _Interrupted:
    """Remembers that this process is to end."""

    def __init__(self) -> None:
        self.seen = False
        hear_ends(self._see)

    def _see(self, *_: object) -> None:
        self.seen = True


def train(
    options: RunOptions,
    *,
    dashboard: bool,
    keys: Path | None = None,
    workers: int | None = None,
    device: Device = "cpu",
) -> int:
    """Train with local processes; the exit code: 0 solved, 3 budget spent, 130 interrupted.

    Args:
        options: what to train.
        dashboard: whether to show it.
        keys: folder of keys, for a machine that is shared with others.
        workers: how many processes learn; None for one per sub-task.
        device: where they train.

    Raises:
        ConfigError: if the sub-tasks cannot be dealt to so many workers, or there is no such device.
        KeyFileError: if the keys cannot be used.
        RunError: if the coordinator or a worker cannot go on.
    """
    check_device(device)
    plan = plan_run(options)
    if plan.solved:
        print(plan.solved)
        return SOLVED
    task = _ready(options, plan)
    hands = dealt(task.decomposition.pids, workers)
    own = None if keys is None else load_client(keys)
    run = RunDirectory(plan.directory, restart=options.restart, resume=plan.resumes)
    directory = run.path
    interrupted = _Interrupted()
    deaths = DeathNotices(own, held=dashboard and _is_live())
    processes = LocalProcesses(directory, deaths)
    secured = [] if keys is None else ["--keys", str(keys.absolute())]
    try:
        control, publish = processes.start_coordinator([*_coordinator_arguments(options), *secured])
        deaths.control = control
        kept = ["--checkpoints", str(run.checkpoints), "--checkpoint-every", str(options.checkpoint_every)]
        for name, hand in hands.items():
            places = [flag for pid in hand for flag in ("--pid", pid)]
            where = ["--connect", control, "--device", device]
            processes.start_worker(name, [*places, *where, *kept, *secured])
        processes.start_worker("evaluator", ["--evaluate", "--connect", control, *secured])
        _watch(processes, publish, interrupted, dashboard, own)
        if interrupted.seen:
            processes.interrupt()
        code = _last_word(processes, interrupted)
    finally:
        deaths.release()
        processes.end()
    if interrupted.seen:
        code = STOPPED
    if code not in (SOLVED, BUDGET_SPENT, STOPPED):
        raise RunError(processes.coordinator_failure())
    _report(directory)
    return code


def _ready(options: RunOptions, plan: RunPlan) -> CompiledTask:
    """The task compiled and its environment checked, before anything is started or written."""
    task = prepared(compile_task(plan.config, translator=options.translator, seed=plan.seed))
    for warning in cautions(task):
        print(f"t4nmtd: warning: {warning}", file=sys.stderr)
    return task


def _coordinator_arguments(options: RunOptions) -> list[str]:
    arguments = ["--translator", options.translator, "--tensorboard", options.tensorboard]
    arguments += ["--checkpoint-every", str(options.checkpoint_every)]
    if options.resume is not None:
        arguments += ["--resume", str(options.resume), "--trust"]  # plan_run has asked already
    if options.task:
        arguments += ["--task", options.task]
    if options.seed is not None:
        arguments += ["--seed", str(options.seed)]
    if options.max_interactions is not None:
        arguments += ["--max-interactions", str(options.max_interactions)]
    for path in options.config:
        arguments += ["--config", str(path)]
    for flag in options.set:
        arguments += ["--set", flag]
    return arguments


def _watch(
    processes: LocalProcesses, publish: str, interrupted: _Interrupted, dashboard: bool, keys: ClientKeys | None
) -> None:
    def keep_going() -> bool:
        return processes.check() and not interrupted.seen

    if dashboard:
        from coordinator.ui.viewer import watch
        from t4nmtd_dist.wire.zmq_types import new_context

        context = new_context()
        watch(context, publish, keep_going=keep_going, keys=keys)
        context.term()
    else:
        while keep_going():
            time.sleep(0.1)


def _last_word(processes: LocalProcesses, interrupted: _Interrupted) -> int | None:
    """The coordinator's exit code; None if it does not end in time."""
    code = processes.coordinator_exit_code(LAST_STATE_S)
    if code is None and not interrupted.seen:
        _say(f"the coordinator is still writing the result; its log is in {processes.run_dir / 'logs'}")
    deadline = time.monotonic() + RESULT_S
    while code is None and not interrupted.seen and time.monotonic() < deadline:
        code = processes.coordinator_exit_code(1.0)
    return code


def _is_live() -> bool:
    """Whether a dashboard takes the whole terminal."""
    from rich.console import Console

    from coordinator.ui.viewer import wants_plain

    return not wants_plain(Console())


def _report(directory: Path) -> None:
    summary = read_summary(directory)
    print(
        f"{summary['task']} seed {summary['seed']}: {outcome_text(summary, directory)}; {summary['wall_s']:.0f} s; "
        f"run directory {directory}"
    )


def _say(text: str) -> None:
    print(f"t4nmtd: {text}", file=sys.stderr, flush=True)


def train_serial(options: RunOptions, *, device: Device = "cpu") -> int:
    """Train in one process, in lock-step; the exit code, and what is raised, as of ``train``."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    check_device(device)
    from coordinator.events import Finish
    from coordinator.finishing import patience, write_result
    from coordinator.run_logger import Recorder
    from coordinator.state import RunSettings
    from t4nmtd_dist.launch.serial import SerialRun
    from t4nmtd_dist.launch.serial_checkpointing import SerialKeeper

    plan = plan_run(options, serial=True)
    if plan.solved:
        print(plan.solved)
        return SOLVED
    task = _ready(options, plan)
    run_dir = RunDirectory(plan.directory, restart=options.restart, resume=plan.resumes)
    run_dir.lock()
    budget, run_id = plan.config.max_interactions, plan.identity.run_id
    settings = RunSettings(plan.seed, budget, str(run_dir.path), lease_s=float("inf"), run_id=run_id)
    interrupted = _Interrupted()
    run = SerialRun(task, settings, time.monotonic, device)
    keeper = SerialKeeper(run, run_dir, options.checkpoint_every)
    if plan.resumes:
        keeper.go_on()
    write_identity(run_dir.path, plan.identity)
    recorder = Recorder(run.coordinator, run_dir, options.tensorboard, _say)
    for notes in run.steps():
        for note in notes:
            recorder.record(note)
        recorder.metrics()
        keeper.turn()
        if interrupted.seen:
            run.stop("interrupted")
    for note in run.notes:
        recorder.record(note)
    if plan.resumes and run.coordinator.outcome == "solved":
        recorder.record(Finish("solved", "the result is written now"))
    write_result(recorder, keeper, _say, patience(lambda: time.sleep(0.1), lambda: interrupted.seen))
    _report(run_dir.path)
    codes = {"solved": SOLVED, "budget spent": BUDGET_SPENT}
    return codes.get(run.coordinator.outcome or "", STOPPED)
