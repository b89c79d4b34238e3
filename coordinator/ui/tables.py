"""The dashboard's tables: learners, and the high-level Q over DFA states and sub-tasks.

Each function draws a ``DashboardState`` into a given size in terminal cells. Colours are legible on dark and light
backgrounds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import groupby

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from coordinator.ui.text import UNKNOWN, bar, clip, count, duration, line, percent, rate, value
from t4nmtd_dist.wire.messages import DashboardState, LearnerRow, QCell
from t4nmtd_dist.wire.messages.statistics import Format, View
from t4nmtd_dist.wire.statistics import viewed, views

LEARNER_STYLE = {"free": "dim", "waiting": "magenta", "training": "green", "lost": "bold red"}
PID_CELLS = 12
NARROW = 96
BAR_CELLS, WIDE_BAR_CELLS = 6, 14
FORMATS: Mapping[Format, Callable[[float], str]] = {
    "count": lambda number: count(int(number)),
    "rate": rate,
    "percent": percent,
    "mean": "{:.1f}".format,
}


def age_style(age_s: float | None) -> str:
    """Colour of a heartbeat's age in seconds: green, magenta from 2 s, red from 10 s."""
    if age_s is None:
        return "dim"
    return "green" if age_s < 2 else "magenta" if age_s < 10 else "bold red"


def _age(row: LearnerRow) -> Text:
    age = row.heartbeat_age_s
    text = "never" if age is None else f"{age:.1f} s" if age < 100 else duration(age)
    return line(text, age_style(age))


def _success_style(share: float | None) -> str:
    if share is None:
        return "dim"
    return "green" if share >= 0.9 else "cyan" if share >= 0.5 else "magenta"


@dataclass(frozen=True)
class _Column:
    """A column of the learners' table, shown from a width of ``needs``."""

    title: str
    needs: int
    cell: Callable[[LearnerRow], str | Text]
    left: bool = False


def _learner_columns(width: int) -> list[_Column]:
    """Columns of the learner, its statistics, and the coordinator's own data."""
    columns = [
        _Column("pid", 0, lambda r: line(clip(r.pid, PID_CELLS), "bold"), left=True),
        _Column("phase", 0, lambda r: line(r.phase, LEARNER_STYLE[r.phase]), left=True),
        _Column("worker", 126, lambda r: clip(r.worker, 20), left=True),
        _Column("epoch", 126, lambda r: count(r.epoch)),
        _Column("version", 140, lambda r: count(r.version)),
        *(_statistic_column(name, view, width) for name, view in views() if view.format),
        _Column("starts", 0, lambda r: count(r.starts_waiting)),
        _Column("heard", 0, _age),
    ]
    return [column for column in columns if width >= column.needs]


def _statistic_column(name: str, view: View, width: int) -> _Column:
    def cell(row: LearnerRow) -> str | Text:
        value = viewed(name, view, row.total, row.rates)
        if view.format == "bar":
            return bar(value, BAR_CELLS if width < 130 else WIDE_BAR_CELLS, _success_style(value))
        text = UNKNOWN if value is None else FORMATS[view.format](value)
        return line(text, _success_style(value)) if name == "recent_success" else text

    title = view.short if view.short and width < NARROW else view.heading
    return _Column(title, view.needs, cell, left=view.format == "bar")


def learners(state: DashboardState, width: int, rows: int) -> RenderableType:
    """One row per learner; a last line counts those that do not fit."""
    columns = _learner_columns(width)
    table = Table(box=None, padding=(0, 1 if width < 120 else 2, 0, 0), pad_edge=False, header_style="dim")
    for column in columns:
        table.add_column(line(column.title), justify="left" if column.left else "right", no_wrap=True)
    fits = len(state.learners) <= rows
    for row in state.learners if fits else state.learners[: max(0, rows - 1)]:
        table.add_row(*(_text(column.cell(row)) for column in columns))
    if fits:
        return table
    return Group(table, line(f"and {len(state.learners) - max(0, rows - 1)} more learners", "dim"))


def _text(cell: str | Text) -> Text:
    return cell if isinstance(cell, Text) else line(cell)


def dist(state: DashboardState, q: int) -> float | None:
    """The dist of q; None if acceptance is unreachable or q unknown."""
    found = state.dist[q] if 0 <= q < len(state.dist) else None
    return found if found is not None and math.isfinite(found) else None


def dist_text(state: DashboardState, q: int) -> str:
    """The dist of q as short text."""
    found = dist(state, q)
    return UNKNOWN if found is None else f"{found:.1f}".removesuffix(".0")


def last_path(state: DashboardState) -> list[int]:
    """The DFA states of the last evaluation's first episode, without consecutive repeats."""
    path = state.evaluations[-1].dfa_path if state.evaluations else []
    return [q for q, _ in groupby(path)]


def q_rows(state: DashboardState, rows: int) -> tuple[list[int], int]:
    """At most ``rows`` DFA states with known values, and the number of others.

    It prefers states on the last evaluation's path, then those with most known values; the result is sorted by number.
    """
    known: dict[int, int] = {}
    for cell in state.q_table:
        known[cell.q] = known.get(cell.q, 0) + 1
    path = set(last_path(state))
    by_relevance = sorted(known, key=lambda q: (q not in path, -known[q], q))
    return sorted(by_relevance[:rows]), max(0, len(known) - rows)


def q_columns(state: DashboardState, width: int) -> tuple[dict[str, int], int]:
    """The pids whose columns fit into ``width``, with widths, and the number of others."""
    cells: dict[str, list[QCell]] = {row.pid: [] for row in state.learners}
    for cell in state.q_table:
        cells.setdefault(cell.pid, []).append(cell)
    shown: dict[str, int] = {}
    room = width - 9
    for pid, column in cells.items():
        need = max(4, len(clip(pid, 8)), *(len(value(cell.value)) for cell in column), 0) + 1
        room -= need + 1
        if room < 0:
            break
        shown[pid] = need
    return shown, len(cells) - len(shown)


def q_width(state: DashboardState, most: int) -> int:
    """Width of the Q-table in cells, at most ``most``."""
    columns, _ = q_columns(state, most)
    return min(most, max(34, 9 + sum(columns.values()) + len(columns)))


def q_table(state: DashboardState, width: int, height: int) -> RenderableType:
    """Q(q, pid) as a matrix: unknown entries blank, greedy choices bold and starred."""
    if not state.q_table:
        return line("no DFA state change seen yet", "dim")
    columns, more_pids = q_columns(state, width)
    rows, more_rows = q_rows(state, height - 1)
    if more_rows or more_pids:
        rows, more_rows = q_rows(state, max(0, height - 2))
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False, header_style="dim")
    table.add_column("q", no_wrap=True, width=3)
    table.add_column("dist", no_wrap=True, justify="right", width=4)
    for pid, need in columns.items():
        table.add_column(line(clip(pid, 8) + " "), no_wrap=True, justify="right", width=need)
    known = {(cell.q, cell.pid): cell for cell in state.q_table}
    path = set(last_path(state))
    for q in rows:
        name = line(f"q{q}", "bold cyan" if q in path else "")
        table.add_row(name, line(dist_text(state, q)), *(_q_cell(known.get((q, pid))) for pid in columns))
    left_out = [f"{more_rows} states"] * bool(more_rows) + [f"{more_pids} sub-tasks"] * bool(more_pids)
    return Group(table, line(f"left out: {', '.join(left_out)}", "dim")) if left_out else table


def _q_cell(cell: QCell | None) -> Text:
    if cell is None:
        return Text()
    return line(value(cell.value) + ("*" if cell.greedy else " "), "bold green" if cell.greedy else "")
