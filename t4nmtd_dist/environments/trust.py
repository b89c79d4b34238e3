"""Asks for the user's consent before foreign code is imported.

A task file named by the user is trusted and remembered. Code named by a policy, a resumed run or a coordinator may be
foreign: it is imported only if remembered or with consent.
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
    """Remember the code of a task file named by the user."""
    if code_named(config):
        remember(config)


def require_trust(
    config: EnvironmentConfig, source: str, *, given: bool, ask: bool = True, otherwise: str = ""
) -> None:
    """Allow foreign code to be imported only if the user trusts it.

    Args:
        config: the section ``[environment]`` that names the code.
        source: its origin, to begin a sentence: ``the policy in X``.
        given: whether the user passed ``--trust``.
        ask: whether to ask at a terminal.
        otherwise: alternative to ``--trust``, for the message.

    Raises:
        TrustError: if the user does not trust it, or a module folder is not absolute.
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
    """Ask at the terminal, if there is one; only yes is consent."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return False
    lines = "".join(f"  {text}\n" for text in named)
    question = "It can do whatever you can do. Import and run it? [y/N] "
    print(
        f"{source} names code that you have not run on this machine before:\n{lines}{question}", end="", file=sys.stderr
    )
    sys.stderr.flush()
    return sys.stdin.readline().strip().casefold() in ("y", "yes")
