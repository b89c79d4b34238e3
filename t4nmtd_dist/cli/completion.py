"""``t4nmtd completion``: scripts with which a shell completes verbs and options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import tyro

Program = Literal["t4nmtd", "t4nmtd-coordinator", "t4nmtd-worker"]


@dataclass(frozen=True)
class Completion:
    """Print a script that teaches a shell to complete commands; start a new shell after installing it.

    bash: t4nmtd completion bash > ~/.local/share/bash-completion/completions/t4nmtd

    zsh: t4nmtd completion zsh > ~/.zfunc/_t4nmtd (with fpath+=~/.zfunc before compinit in ~/.zshrc)

    fish: t4nmtd completion fish > ~/.config/fish/completions/t4nmtd.fish
    """

    shell: Annotated[Literal["bash", "zsh", "fish"], tyro.conf.Positional]
    """The shell."""
    program: Program = "t4nmtd"
    """The command to be completed; name the file after it."""

    def run(self) -> int:
        """Print."""
        tyro.cli(_command(self.program), prog=self.program, args=["--tyro-print-completion", self.shell])
        return 0


def _command(program: Program) -> Any:
    """What a program's command line is read into."""
    if program == "t4nmtd-coordinator":
        from t4nmtd_dist.cli.coordinator import CoordinatorCommand

        return CoordinatorCommand
    if program == "t4nmtd-worker":
        from t4nmtd_dist.cli.worker import WorkerCommand

        return WorkerCommand
    from t4nmtd_dist.cli.commands import Command

    return Command
