"""Describes exceptions from user code: type, text, and location in that code."""

from __future__ import annotations

import sysconfig
import traceback
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

from t4nmtd_dist.core.errors import EnvError, T4NMTDError

MOST_FRAMES = 4
OWN = ("t4nmtd_dist", "coordinator", "workers", "gymnasium")
Result = TypeVar("Result")


def call_user(who: str, what: str, function: Callable[..., Result], *arguments: Any, **keywords: Any) -> Result:
    """Call a function ``what`` of a user's object ``who``, such as "environment 'module:make'".

    Raises:
        EnvError: if it raises.
    """
    try:
        return function(*arguments, **keywords)
    except T4NMTDError:
        raise
    except Exception as error:
        kind, _, text = described(error).partition(": ")
        raise EnvError(f"{who} raised {kind} in {what}: {text}") from error


def described(error: BaseException) -> str:
    """Type and text of an exception, then the innermost calls in user code with their lines.

    If no call is in user code, the innermost calls overall are shown.
    """
    if isinstance(error, SyntaxError):
        where = _line(error.filename or "?", error.lineno or 0, "", (error.text or "").strip())
        return f"{type(error).__name__}: {error.msg}\n{where}"
    return f"{type(error).__name__}: {error}{calls(error) or _shown(traceback.extract_tb(error.__traceback__)[-2:])}"


def calls(error: BaseException) -> str:
    """The innermost calls in user code, two lines each, outermost first; "" if there are none."""
    found = [frame for frame in traceback.extract_tb(error.__traceback__) if not _is_in(frame.filename, _own_folders())]
    written = [frame for frame in found if not _is_in(frame.filename, _library_folders())]
    return _shown((written or found)[-MOST_FRAMES:])


def _shown(frames: list[traceback.FrameSummary]) -> str:
    return "".join(
        "\n" + _line(frame.filename, frame.lineno or 0, f", in {frame.name}", frame.line or "") for frame in frames
    )


def _line(file: str, number: int, function: str, source: str) -> str:
    return f'  File "{file}", line {number}{function}' + (f"\n    {source}" if source else "")


def _is_in(file: str, folders: list[str]) -> bool:
    return file.startswith("<frozen ") or any(file.startswith(folder) for folder in folders)


def _own_folders() -> list[str]:
    """Folders of our packages and of gymnasium."""
    specs = [find_spec(name) for name in OWN]
    return [f"{Path(spec.origin).parent}/" for spec in specs if spec is not None and spec.origin is not None]


def _library_folders() -> list[str]:
    return [f"{sysconfig.get_path(name)}/" for name in ("stdlib", "purelib", "platlib")]
