"""Parses the three programs' command lines; handles ``--version`` first."""

from __future__ import annotations

import sys
from typing import Any

import tyro

from t4nmtd_dist.core.version import __version__


def parse(command: Any, program: str, description: str | None) -> Any:
    """Parse the command line; exits for ``--version`` and ``--help``.

    Args:
        command: a dataclass, or a union of them for subcommands.
        program: its name.
        description: of the program, or None.
    """
    if sys.argv[1:2] == ["--version"]:
        print(f"{program} {__version__}")
        sys.exit(0)
    return tyro.cli(command, prog=program, description=f"{description or ''} Use --version for the version.".strip())


def check_verb(verbs: list[str]) -> None:
    """Exit with a suggestion if the first word is not a subcommand."""
    word = next(iter(sys.argv[1:]), "-")
    if word.startswith("-") or word in verbs:
        return
    import difflib

    near = difflib.get_close_matches(word.lower(), verbs, n=1, cutoff=0.5)
    advice = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(sorted(verbs))}"
    print(f"t4nmtd: unknown command {word!r}; {advice}", file=sys.stderr)
    sys.exit(2)
