"""What a run came to, in the words of every report of it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any


def outcome_text(summary: Mapping[str, Any], run: Path) -> str:
    """How a run ended, after how many interactions, and where its best policy is.

    Args:
        summary: of the run, as ``summary.json`` has it; one of an older version will do.
        run: the run directory.
    """
    total, policy = int(summary["interactions_total"]), summary.get("policy")
    if summary["solved"]:
        first = summary["interactions"]
        told = solved_text(total if first is None else int(first), total, int(summary.get("in_a_row", 1)))
    else:
        told = f"{summary['outcome']} after {total:,} interactions"
    if policy is None and not summary.get("evaluations"):
        return f"{told}; no evaluation, so there is no policy"
    if policy is None:
        return told
    return f"{told}; {policy_text(policy['success_rate'], policy['actions'], policy['interactions'], run)}"


def solved_text(first: int, total: int, in_a_row: int) -> str:
    """After how many interactions a task was solved.

    Args:
        first: interactions before the first of the evaluations that solved it.
        total: interactions in all.
        in_a_row: how many evaluations in a row it took.
    """
    row = f" (the first of {in_a_row} evaluations in a row)" if in_a_row > 1 else ""
    return f"solved after {first:,} interactions{row}, {total:,} in all"


def policy_text(success_rate: float, actions: str, interactions: int, run: Path) -> str:
    """How good the exported policy is, and where."""
    return (
        f"best evaluation {percent_text(success_rate)} with {actions} actions at {interactions:,} interactions, "
        f"policy in {run / 'policy'}"
    )


def row_text(success_needed: float) -> str:
    """Which evaluations count towards those in a row."""
    return f"{'' if success_needed == 1 else 'at least '}{percent_text(success_needed)} successful in a row"


def percent_text(share: float) -> str:
    """A share from 0 to 1 in percent, exact enough not to round 0.995 to 100 %."""
    return f"{100 * share:.4g}%"
