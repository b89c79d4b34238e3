"""Entry points of the programs, with a check that no package hides ours."""

from __future__ import annotations

import sys

from t4nmtd_dist.core.errors import ImportNameError
from t4nmtd_dist.process.import_names import check_import_names


def t4nmtd() -> None:
    """Entry point of ``t4nmtd``."""
    _check("t4nmtd")
    from t4nmtd_dist.cli.main import main

    main()


def coordinator() -> None:
    """Entry point of ``t4nmtd-coordinator``."""
    _check("t4nmtd-coordinator")
    from t4nmtd_dist.cli.coordinator import main

    main()


def worker() -> None:
    """Entry point of ``t4nmtd-worker``."""
    _check("t4nmtd-worker")
    from t4nmtd_dist.cli.worker import main

    main()


def _check(program: str) -> None:
    try:
        check_import_names()
    except ImportNameError as error:
        print(f"{program}: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    {"coordinator": coordinator, "worker": worker, "t4nmtd": t4nmtd}[sys.argv.pop(1)]()
