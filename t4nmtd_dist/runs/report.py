"""The wording of run results, shared by all reports."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any


def outcome_text(summary: Mapping[str, Any], run: Path) -> str:
    """How a run ended, after how many interactions, and where its best policy is.

    Args:
        summary: content of ``summary.json``, also from older versions.
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
        first: interactions before the first of the solving evaluations.
        total: all interactions.
        in_a_row: number of consecutive evaluations needed.
    """
    row = f" (the first of {in_a_row} evaluations in a row)" if in_a_row > 1 else ""
    return f"solved after {first:,} interactions{row}, {total:,} in all"


def policy_text(success_rate: float, actions: str, interactions: int, run: Path) -> str:
    """The exported policy's success rate and location."""
    return (
        f"best evaluation {percent_text(success_rate)} with {actions} actions at {interactions:,} interactions, "
        f"policy in {run / 'policy'}"
    )


def row_text(success_needed: float) -> str:
    """Which evaluations count as consecutive successes."""
    return f"{'' if success_needed == 1 else 'at least '}{percent_text(success_needed)} successful in a row"


def percent_text(share: float) -> str:
    """A share from 0 to 1 in percent, without rounding 0.995 to 100 %."""
    return f"{100 * share:.4g}%"
