"""Before anything is opened that came from elsewhere: does the user want to run the code that it names?

A task file that the user names is his own choice, and is remembered as such. A policy, a run to resume and a
coordinator may be a stranger's: nothing that they name is imported unless it is remembered, or the user says so.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from t4nmtd_dist.core.config import EnvironmentConfig
from t4nmtd_dist.core.errors import TrustError
from t4nmtd_dist.environments.named_code import code_named
from t4nmtd_dist.environments.trusted_code import is_remembered, remember


def remember_own(config: EnvironmentConfig) -> None:
    """Remember the code of a task file that the user has named."""
    if code_named(config):
        remember(config)


def require_trust(
    config: EnvironmentConfig, source: str, *, given: bool, ask: bool = True, otherwise: str = ""
) -> None:
    """Let code that came from elsewhere be imported only if the user trusts it.

    Args:
        config: the section ``[environment]`` that names the code.
        source: where it came from, to begin a sentence: ``the policy in X``.
        given: whether the user has passed ``--trust``.
        ask: whether to ask the user if this process has a terminal.
        otherwise: what the user can do instead of passing ``--trust``.

    Raises:
        TrustError: if the user has not said that he trusts it, or a folder of modules is not absolute.
    """
    named = code_named(config)
    if not named:
        return
    for folder in config.folders:
        if not os.path.isabs(folder):
            raise TrustError(
                f"{source} names the relative folder {folder!r} in environment.path, which would be another one "
                "wherever this is run; expected an absolute folder"
            )
    if is_remembered(config):
        return
    if not given and not (ask and _agreed(source, named)):
        raise TrustError(
            f"{source} names code that you have not run on this machine before, and nothing of it was imported: "
            f"{'; '.join(named)}. If you would run any program from whoever made it, pass --trust{otherwise}"
        )
    remember(config)


def _agreed(source: str, named: Sequence[str]) -> bool:
    """Ask at the terminal, if there is one; anything but yes is no."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return False
    lines = "".join(f"  {text}\n" for text in named)
    question = "It can do whatever you can do. Import and run it? [y/N] "
    print(
        f"{source} names code that you have not run on this machine before:\n{lines}{question}", end="", file=sys.stderr
    )
    sys.stderr.flush()
    return sys.stdin.readline().strip().casefold() in ("y", "yes")
