"""Prints shell completion scripts for the programs."""

from __future__ import annotations

from typing import Any

import tyro


def print_completion(shell: str, program: str, *, verbs: Any) -> int:
    """Print a program's completion script.

    Args:
        shell: ``bash``, ``zsh`` or ``fish``.
        program: ``t4nmtd``, ``t4nmtd-coordinator`` or ``t4nmtd-worker``.
        verbs: the type that ``t4nmtd``'s command line is parsed into.

    Returns:
        Exit code.
    """
    tyro.cli(_command(program, verbs), prog=program, args=["--tyro-print-completion", shell])
    return 0


def _command(program: str, verbs: Any) -> Any:
    """The type for a program's command line."""
    if program == "t4nmtd-coordinator":
        from t4nmtd_dist.cli.coordinator import CoordinatorCommand

        return CoordinatorCommand
    if program == "t4nmtd-worker":
        from t4nmtd_dist.cli.worker import WorkerCommand

        return WorkerCommand
    return verbs
