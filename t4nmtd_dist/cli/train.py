"""``t4nmtd train``: starts everything on this machine and shows the dashboard."""

from __future__ import annotations

import sys
from pathlib import Path

from t4nmtd_dist.core.devices import Device, check_device
from t4nmtd_dist.core.registry import LAUNCHERS
from t4nmtd_dist.launch.build import build_program
from t4nmtd_dist.launch.protocol import SOLVED
from t4nmtd_dist.launch.run import launch
from t4nmtd_dist.runs.directory import read_summary
from t4nmtd_dist.runs.options import RunOptions
from t4nmtd_dist.runs.planning import plan_run
from t4nmtd_dist.runs.report import outcome_text
from t4nmtd_dist.runs.resuming import SERIAL


def train(
    options: RunOptions,
    *,
    launcher: str = "local",
    dashboard: bool = False,
    keys: Path | None = None,
    workers: int | None = None,
    device: Device = "cpu",
) -> int:
    """Train; returns the exit code: 0 solved, 3 budget spent, 130 interrupted.

    Args:
        options: of the run.
        launcher: a key of ``core.registry.LAUNCHERS``.
        dashboard: whether to show it.
        keys: folder of keys, for a shared machine.
        workers: number of learner processes; None for one per sub-task.
        device: where they train.

    Raises:
        ConfigError: if launcher, device or number of workers is invalid.
        KeyFileError: if the keys cannot be used.
        RunError: if a process cannot continue.
    """
    LAUNCHERS.check(launcher, "--launcher")
    check_device(device)
    plan = plan_run(options, serial=launcher == SERIAL, warn=_warn)
    if plan.solved:
        print(plan.solved)
        return SOLVED
    program = build_program(plan, options, workers=workers, device=device, keys=keys, dashboard=dashboard, warn=_warn)
    code = launch(program, launcher)
    _report(program.directory)
    return code


def _report(directory: Path) -> None:
    summary = read_summary(directory)
    print(
        f"{summary['task']} seed {summary['seed']}: {outcome_text(summary, directory)}; {summary['wall_s']:.0f} s; "
        f"run directory {directory}"
    )


def _warn(text: str) -> None:
    print(f"t4nmtd: warning: {text}", file=sys.stderr)
