"""The summary of ``t4nmtd inspect``: an automaton of any size on one screen."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterator
from typing import Any

Inspection = dict[str, Any]

MOST_FORMULA_LINES = 3
MOST_SUBTASKS = 12
MOST_BARS = 10
MOST_NAME = 30
BAR_WIDTH = 40


def summary_lines(title: str, formula: str, found: Inspection, width: int) -> list[str]:
    """The summary, at most 40 lines.

    Args:
        title: the heading.
        formula: the task in LTLf.
        found: from ``t4nmtd_dist.cli.inspect.inspection``.
        width: of the terminal, in characters.
    """
    lines = [*_cut(title, width, 1), *_cut(" ".join(formula.split()), width, MOST_FORMULA_LINES), ""]
    lines += [*_counts(found, width), "", "Sub-tasks (transitions; distance to acceptance where they start)"]
    lines += [*_subtasks(found), *left_out_lines(found, width), "", "States by distance to acceptance", *_bars(found)]
    return [line[:width] for line in lines]


def left_out_lines(found: Inspection, width: int) -> list[str]:
    """Lines about sub-tasks without a learner of their own, if any."""
    lines: list[str] = []
    if left_out := found.get("left_out"):
        lines += _cut(f"left out: {', '.join(left_out)} (no transition of it brings acceptance nearer)", width, 2)
    if together := [pid for pid in found["subtasks"] if "&" in pid]:
        lines += _cut(f"merged: {', '.join(together)} (equal transitions)", width, 2)
    return lines


def _counts(found: Inspection, width: int) -> list[str]:
    unreachable = sum(dist is None for dist in found["dist"].values()) - len(found["error"])
    farthest = max((dist for dist in found["dist"].values() if dist is not None), default=0)
    lines = _cut(
        f"{found['states']} states, {found['transitions']} transitions, {len(found['propositions'])} propositions: "
        f"{', '.join(found['propositions'])}",
        width,
        3,
    )
    if left := found.get("reduced"):
        lines.append(f"with exclusive propositions: {left['states']} states, {left['transitions']} transitions")
    lines.append(f"accepting: {len(found['accepting'])}, error: {len(found['error'])}, out of reach: {unreachable}")
    lines.append(f"farthest from acceptance: {farthest:.4g} transitions")
    return lines


def _subtasks(found: Inspection) -> Iterator[str]:
    subtasks = found["subtasks"]
    shown = dict(list(subtasks.items())[:MOST_SUBTASKS])
    name_width = min(MOST_NAME, max(map(len, shown), default=0))
    for pid, taus in shown.items():
        dist = [d for q, _ in taus if (d := found["dist"][str(q)]) is not None]
        where = f"{min(dist):.4g} to {max(dist):.4g}" if dist else "-"
        name = pid if len(pid) <= MOST_NAME else f"{pid[: MOST_NAME - 1]}…"
        yield f"  {name:<{name_width}}  {len(taus):>7}  {where}"
    if len(subtasks) > len(shown):
        yield f"  and {len(subtasks) - len(shown)} more"


def _bars(found: Inspection) -> Iterator[str]:
    """A histogram of states by distance, with at most ``MOST_BARS`` bars."""
    finite = Counter(int(dist) for dist in found["dist"].values() if dist is not None)
    span = -(-(max(finite, default=0) + 1) // MOST_BARS)
    bars = Counter({first: sum(finite[first + i] for i in range(span)) for first in range(0, max(finite) + 1, span)})
    for first, count in sorted(bars.items()):
        label = str(first) if span == 1 else f"{first}-{first + span - 1}"
        yield f"  {label:>9}  {count:>6}  {'#' * -(-count * BAR_WIDTH // max(bars.values()))}"


def _cut(text: str, width: int, most: int) -> list[str]:
    return textwrap.wrap(text, width, max_lines=most, placeholder=" …", break_on_hyphens=False) or [""]
