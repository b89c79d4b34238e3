"""``t4nmtd status``: shows the status of a coordinator's run."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec

from t4nmtd_dist.core.errors import ProtocolError, RunError
from t4nmtd_dist.runs.report import policy_text, row_text, solved_text
from t4nmtd_dist.runs.running import RunOverError
from t4nmtd_dist.wire.auth.keys import load_client
from t4nmtd_dist.wire.messages import LearnerRow, Status
from t4nmtd_dist.wire.status_client import ask_status
from t4nmtd_dist.wire.zmq_types import new_context

HEALTHY, SICK = 0, 1


def show_status(endpoint: str, keys: Path | None, wait_s: float, *, check: bool, as_json: bool) -> int:
    """Print a coordinator's status.

    Args:
        endpoint: its control endpoint.
        keys: folder of a client's keys.
        wait_s: timeout in seconds.
        check: print only problems.
        as_json: print JSON instead of text.

    Returns:
        0 if the coordinator answered, else 1.

    Raises:
        ConfigError: if the endpoint is malformed.
        KeyFileError: if the keys cannot be used.
    """
    own = None if keys is None else load_client(keys)
    context = new_context()
    try:
        status = ask_status(context, endpoint, own, wait_s)
    except (RunError, ProtocolError) as error:
        print(f"t4nmtd status: {error}", file=sys.stderr)
        return SICK
    finally:
        context.term()
    if as_json:
        print(json.dumps({key: value for key, value in msgspec.to_builtins(status).items() if key != "type"}))
    elif not check:
        print(page(status))
    return HEALTHY


def tell_ending(over: RunOverError, *, for_people: bool) -> int:
    """Report the requested run's end: to users on stdout, for programs on stderr; returns 1."""
    if for_people:
        print(over)
    else:
        print(f"t4nmtd status: {over}", file=sys.stderr)
    return SICK


def page(status: Status) -> str:
    """A status as text."""
    success = "none yet" if status.success_rate is None else f"{status.success_rate:.0%}"
    lines = [
        f"{status.task} seed {status.seed}: {status.phase} for {status.elapsed_s:.0f} s, "
        f"{status.interactions} of {status.max_interactions} interactions",
        f"last evaluation: {success}, {row_text(status.success_needed)}: "
        f"{status.solved_in_a_row} of {status.solved_needed}",
        *_result(status),
        *(_learner(row) for row in status.learners),
        f"evaluator: {status.evaluator or 'none'}",
        *(lack.text for lack in status.missing),
    ]
    return "\n".join(lines)


def _result(status: Status) -> Iterator[str]:
    if status.solved_at is not None:
        yield solved_text(status.solved_at, status.interactions, status.solved_needed)
    if status.policy is not None:
        best = status.policy
        yield policy_text(best.success_rate, best.actions, best.interactions, Path(status.run_dir))


def _learner(row: LearnerRow) -> str:
    age = "" if row.heartbeat_age_s is None else f", heard {row.heartbeat_age_s:.1f} s ago"
    hint = "".join(f"\n  {line}" for line in row.hint.splitlines())
    return f"{row.pid}: {row.phase}, {row.worker or 'no worker'}, {row.total.interactions} interactions{age}{hint}"
