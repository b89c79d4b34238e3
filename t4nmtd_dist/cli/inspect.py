"""`t4nmtd inspect`: a task's automaton, potentials and sub-tasks, as text, JSON or SVG."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from t4nmtd_dist.automata.acceptance import ACCEPTANCE_TEXT, Acceptance, task_automaton
from t4nmtd_dist.automata.cubes import cube_text
from t4nmtd_dist.automata.deadline import Deadline
from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.automata.drawing import draw_svg
from t4nmtd_dist.automata.formula import parse
from t4nmtd_dist.automata.reduction import ExclusiveGroups, reduce_automaton
from t4nmtd_dist.automata.translate import Translator, translate
from t4nmtd_dist.cli.inspect_summary import left_out_lines, summary_lines
from t4nmtd_dist.core.config import TaskConfig, task_config
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.core.setting_sources import merge, settings_from_flags
from t4nmtd_dist.method.compiled import decomposed
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.potential import DistanceMode, distances, potentials

Inspection = dict[str, Any]

MOST_STATES = 60
"""Of an automaton whose full page is printed without being asked for."""
MOST_DRAWN = 600
"""Transitions of an automaton that is drawn: a picture of more takes minutes, and nobody could read it."""


def formula_task(formula: str, flags: Sequence[str]) -> TaskConfig:
    """A task from a formula and settings, without an environment.

    Args:
        formula: LTLf.
        flags: ``key=value`` settings.

    Raises:
        FormulaError: on a syntax error.
        ConfigError: on an unknown setting or one out of range.
    """
    base = {
        "name": "formula",
        "formula": formula,
        "propositions": sorted(parse(formula).propositions()),
        "environment": {"id": "none", "horizon": 1},
    }
    return task_config(merge(base, settings_from_flags(flags)), source="--set")


def run_inspect(
    task: TaskConfig,
    *,
    console: Console,
    translator: Translator = "auto",
    as_json: bool = False,
    svg: Path | None = None,
    summary: bool | None = None,
    seed: int = 0,
) -> None:
    """Translate a task's formula and show the result.

    Args:
        task: any task, or a ``formula_task``.
        console: where to print.
        translator: ``auto``, ``mona`` or ``python``.
        as_json: print one JSON object instead of the page.
        svg: also draw the automaton to this file.
        summary: print the summary instead of the page; None for automata of more than 60 states.
        seed: of the random decomposition; unused by other modes.

    Raises:
        T4NMTDError: if the formula, the settings or the file cannot be used, or the time limit passes.
    """
    settings = task.decomposition
    deadline = Deadline.after(settings.time_limit)
    formula = translate(task.formula, propositions=task.propositions, translator=translator, deadline=deadline)
    dfa, acceptance = task_automaton(formula, task.acceptance, task.exclusive)
    decomposition = decomposed(task, dfa, seed=seed, deadline=deadline)
    found = inspection(
        dfa,
        exclusive=task.exclusive,
        dist_mode=settings.dist,
        decomposition=decomposition,
        acceptance=acceptance,
        deadline=deadline,
    )
    if svg is not None:
        _check_drawable(dfa)
        _write(svg, draw_svg(dfa, decomposition.subtasks))
    if as_json:
        console.out(json.dumps(found, indent=1), highlight=False)
        return
    _print_page(console, f"{task.name}: {task.title}" if task.title else task.name, task.formula, found, summary)
    if svg is not None:
        console.print(Text(f"Picture written to {svg}"))


def inspection(
    dfa: DFA,
    *,
    exclusive: ExclusiveGroups,
    dist_mode: DistanceMode,
    decomposition: Decomposition,
    acceptance: Acceptance = "first",
    deadline: Deadline | None = None,
) -> Inspection:
    """All that ``inspect`` shows, as JSON data.

    Returns:
        ``acceptance`` (``first`` or ``end``), ``propositions``, ``states`` and ``transitions`` (counts), ``initial``,
        ``accepting``, ``error``, ``edges`` (source, target and guard: a list of cubes, each a list of literals),
        ``dist`` and ``potential`` (by state as text; dist is null if acceptance is unreachable), and ``subtasks`` (pid
        to [[q, q'], ...]). If ``exclusive`` reduces the automaton, ``reduced`` has the remaining states and
        transitions; if sub-tasks were dropped, ``left_out`` names them.

    Raises:
        ConfigError: if the deadline passes.
    """
    reduced = reduce_automaton(dfa, exclusive)
    dist = distances(dfa, exclusive=exclusive, mode=dist_mode, deadline=deadline)
    dfa.find_edges(deadline)
    found: Inspection = {
        "acceptance": acceptance,
        **dfa.to_json(),
        "transitions": len(dfa.edges),
        "dist": {str(q): d if math.isfinite(d) else None for q, d in dist.items()},
        "potential": {str(q): float(rho) for q, rho in enumerate(potentials(dfa, dist))},
        "subtasks": decomposition.to_json(),
    }
    left = {"states": len(reduced.states), "transitions": len(reduced.transitions)}
    if left != {key: found[key] for key in left}:
        found["reduced"] = left
    if decomposition.left_out:
        found["left_out"] = list(decomposition.left_out)
    return found


def _check_drawable(dfa: DFA) -> None:
    if len(dfa.edges) > MOST_DRAWN:
        raise ConfigError(
            f"--svg: the automaton has {len(dfa.edges)} transitions; at most {MOST_DRAWN} can be drawn. Declare "
            "exclusive groups or leave out --svg; --summary shows automata of any size"
        )


def _print_page(console: Console, title: str, formula: str, found: Inspection, summary: bool | None) -> None:
    """Print the summary if requested or, by default, for large automata; else the full page."""
    if summary is False or (summary is None and found["states"] <= MOST_STATES):
        print_inspection(console, title, formula, found)
        return
    for line in summary_lines(title, formula, found, console.width):
        console.print(Text(line), no_wrap=True)
    if summary is None:
        console.print(Text(f"This is the summary, for more than {MOST_STATES} states; --full prints the full page."))


def print_inspection(console: Console, title: str, formula: str, found: Inspection) -> None:
    """Print an inspection as a page, readable from 80 columns.

    Args:
        console: where to print.
        title: the heading.
        formula: the task in LTLf.
        found: from ``inspection``.
    """
    console.print(Text(title, style="bold"))
    console.print(Text(" ".join(formula.split()), style="italic"))
    console.print()
    console.print(Text(_summary(found)))
    console.print()
    console.print(_states(found))
    console.print(_edges(found))
    console.print(_subtasks(found))
    for line in left_out_lines(found, console.width):
        console.print(Text(line))


def _summary(found: Inspection) -> str:
    text = (
        f"{found['states']} states, {found['transitions']} transitions, propositions {', '.join(found['propositions'])}"
    )
    text += f"\nAccepts {ACCEPTANCE_TEXT[found['acceptance']]}"
    if left := found.get("reduced"):
        text += (
            f"\nWithout the symbols that exclusive propositions rule out: "
            f"{left['states']} states, {left['transitions']} transitions"
        )
    return text


def _table(title: str, *columns: str, right: Sequence[str] = ()) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    for name in columns:
        table.add_column(name, justify="right" if name in right else "left", overflow="fold")
    return table


def _states(found: Inspection) -> Table:
    table = _table("States", "q", "role", "dist", "rho", "sub-tasks", right=("q", "dist", "rho"))
    able: dict[int, dict[str, None]] = {}
    for pid, taus in found["subtasks"].items():
        for q, _ in taus:
            able.setdefault(q, {})[pid] = None
    for q in range(found["states"]):
        dist = found["dist"][str(q)]
        role = _role(found, q)
        table.add_row(
            str(q),
            role,
            "-" if dist is None else f"{dist:.4g}",
            f"{found['potential'][str(q)]:.2f}",
            ", ".join(able.get(q, ())),
            style={"accepting": "green", "error": "dim", "out of reach": "dim"}.get(role),
        )
    return table


def _role(found: Inspection, q: int) -> str:
    if q == found["initial"]:
        return "initial"
    if q in found["accepting"]:
        return "accepting"
    if q in found["error"]:
        return "error"
    return "out of reach" if found["dist"][str(q)] is None else ""


def _edges(found: Inspection) -> Table:
    """Every edge with its sub-tasks; one guard cube per line."""
    table = _table("Transitions", "q", "q'", "guard", "sub-tasks", right=("q", "q'"))
    owning: dict[tuple[int, int], list[str]] = {}
    for pid, taus in found["subtasks"].items():
        for source, to in taus:
            owning.setdefault((source, to), []).append(pid)
    for edge in found["edges"]:
        q, target = edge["source"], edge["target"]
        guard = "\n".join(cube_text(tuple(cube)) for cube in edge["guard"])
        owners = owning.get((q, target), [])
        table.add_row(str(q), str(target), Text(guard), ", ".join(owners), style=None if owners else "dim")
    return table


def _subtasks(found: Inspection) -> Table:
    table = _table("Sub-tasks", "pid", "transitions", "Q_target(q)", right=("transitions",))
    for pid, taus in found["subtasks"].items():
        table.add_row(pid, str(len(taus)), _targets(taus))
    return table


def _targets(taus: Sequence[Sequence[int]]) -> str:
    """``q → {q', ...}`` for every source q."""
    targets: dict[int, list[int]] = {}
    for q, to in sorted(map(tuple, taus)):
        targets.setdefault(q, []).append(to)
    return "   ".join(f"{q} → {{{', '.join(map(str, to))}}}" for q, to in targets.items())


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}; choose another file") from error
