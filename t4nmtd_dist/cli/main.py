"""Entry point of ``t4nmtd``."""

from __future__ import annotations

import os
import sys
from typing import get_args

from t4nmtd_dist.cli.commands import Command
from t4nmtd_dist.cli.entry import check_verb, parse
from t4nmtd_dist.core.errors import T4NMTDError


def main() -> None:
    """Run the subcommand and exit with its code; 2 for user-fixable errors."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported
    check_verb([verb.__name__.lower() for verb in get_args(Command)])
    command = parse(Command, "t4nmtd", "Learn tasks with memory.")
    try:
        code = command.run()
    except T4NMTDError as error:
        print(f"t4nmtd: {error}", file=sys.stderr)
        code = 2
    except KeyboardInterrupt:
        code = 130
    except BrokenPipeError:
        sys.stderr.close()
        code = 0
    sys.exit(code)


if __name__ == "__main__":
    main()
