"""Command lines of a program's roles, for launchers."""

from __future__ import annotations

import sys

from t4nmtd_dist.launch.program import Program, Role
from t4nmtd_dist.runs.directory import CHECKPOINTS_FOLDER


def python_command(script: str) -> list[str]:
    """The command for ``coordinator`` or ``worker``, without the current folder on Python's path."""
    return [sys.executable, "-P", "-m", "t4nmtd_dist.cli.programs", script]


def coordinator_command(program: Program) -> list[str]:
    """The coordinator's command line; the launcher adds ``--bind`` and ``--publish``."""
    options = program.options
    command = [*python_command("coordinator"), "--translator", options.translator, "--tensorboard", options.tensorboard]
    command += ["--checkpoint-every", str(options.checkpoint_every)]
    if options.resume is not None:
        command += ["--resume", str(options.resume), "--trust"]  # the plan has already checked this
    if options.task:
        command += ["--task", options.task]
    if options.seed is not None:
        command += ["--seed", str(options.seed)]
    if options.max_interactions is not None:
        command += ["--max-interactions", str(options.max_interactions)]
    if options.transfer_from is not None:
        command += ["--transfer-from", str(options.transfer_from)]
    if options.method:
        command += ["--method", options.method]
    if options.preset:
        command += ["--preset", options.preset]
    for path in options.config:
        command += ["--config", str(path)]
    for setting in options.set:
        command += ["--set", setting]
    return [*command, *_keys(program), "--run-dir", str(program.directory), "--no-dashboard"]


def worker_command(program: Program, role: Role, control: str) -> list[str]:
    """The command line of a learner or evaluator.

    Args:
        program: the program.
        role: one of its workers.
        control: the coordinator's endpoint, as the worker's machine reaches it.
    """
    command = [*python_command("worker"), "--connect", control, "--instance", role.name, *_keys(program)]
    if role.kind == "evaluator":
        return [*command, "--evaluate"]
    command += [flag for pid in role.pids for flag in ("--pid", pid)]
    command += ["--device", program.device, "--checkpoints", str(program.directory / CHECKPOINTS_FOLDER)]
    return [*command, "--checkpoint-every", str(program.options.checkpoint_every)]


def _keys(program: Program) -> list[str]:
    return [] if program.keys is None else ["--keys", str(program.keys.absolute())]
