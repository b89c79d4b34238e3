"""`t4nmtd inspect`: a task's automaton, potentials and sub-tasks, as a terminal page, JSON or SVG."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from t4nmtd_dist.automata.acceptance import ACCEPTANCE_TEXT, Acceptance, task_automaton
from t4nmtd_dist.automata.cubes import cube_text
from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.automata.drawing import draw_svg
from t4nmtd_dist.automata.reduction import ExclusiveGroups, reduce_automaton
from t4nmtd_dist.automata.translate import Translator, translate
from t4nmtd_dist.config import AcceptanceSetting
from t4nmtd_dist.decomposition import Decomposition, Mode, decompose
from t4nmtd_dist.errors import ConfigError
from t4nmtd_dist.potential import DistanceMode, distances, potentials

Inspection = dict[str, Any]


def run_inspect(
    *,
    name: str,
    title: str,
    formula: str,
    exclusive: ExclusiveGroups,
    propositions: Sequence[str] | None,
    translator: Translator,
    acceptance: AcceptanceSetting = "auto",
    mode: Mode,
    prune: bool,
    dist_mode: DistanceMode,
    as_json: bool,
    svg: Path | None,
    console: Console,
) -> None:
    """Translate a formula and show what becomes of it.

    Args:
        name: the task's short name, for headings.
        title: one line that says what the task is.
        formula: the task in LTLf.
        exclusive: groups of propositions that can never hold together.
        propositions: AP; by default the propositions of the formula.
        translator: ``auto``, ``mona`` or ``python``.
        acceptance: when a trace is accepted.
        mode: the decomposition.
        prune: leave out transitions that no simple path to acceptance takes.
        dist_mode: ``shortest`` or ``mean``.
        as_json: print the inspection as one JSON object in place of the page.
        svg: write a picture of the automaton to this file.
        console: where to print.

    Raises:
        T4NMTDError: if the formula, the settings or the file cannot be used.
    """
    automaton = translate(formula, propositions=propositions, translator=translator)
    dfa, accepts = task_automaton(automaton, acceptance, exclusive)
    decomposition = decompose(dfa, exclusive=exclusive, mode=mode, prune=prune)
    found = inspection(dfa, exclusive=exclusive, dist_mode=dist_mode, decomposition=decomposition, acceptance=accepts)
    if svg is not None:
        _write(svg, draw_svg(dfa, decomposition))
    if as_json:
        console.out(json.dumps(found, indent=1), highlight=False)
        return
    print_inspection(console, f"{name}: {title}" if title else name, formula, found)
    if svg is not None:
        console.print(Text(f"Picture written to {svg}"))


def inspection(
    dfa: DFA,
    *,
    exclusive: ExclusiveGroups,
    dist_mode: DistanceMode,
    decomposition: Decomposition,
    acceptance: Acceptance = "first",
) -> Inspection:
    """All that ``inspect`` shows, ready for JSON.

    Returns:
        ``acceptance`` (``first`` or ``end``), ``propositions``, ``states`` and ``transitions`` (how many),
        ``initial``, ``accepting``, ``error``, ``edges`` (source, target and guard: a list of cubes, each a list of
        literals), ``dist`` and ``potential`` (by state as text; dist is null where acceptance is out of reach), and
        ``subtasks`` (pid to [[q, q'], ...]). Where ``exclusive`` makes the automaton smaller, ``reduced`` says how
        many states and transitions are left.
    """
    reduced = reduce_automaton(dfa, exclusive)
    dist = distances(dfa, exclusive=exclusive, mode=dist_mode)
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
    return found


def print_inspection(console: Console, title: str, formula: str, found: Inspection) -> None:
    """Print an inspection as a page that is readable from 80 columns.

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


def _summary(found: Inspection) -> str:
    text = (
        f"{found['states']} states, {found['transitions']} transitions, propositions {', '.join(found['propositions'])}"
    )
    text += f"\nAccepts {ACCEPTANCE_TEXT[found['acceptance']]}"
    if left := found.get("reduced"):
        text += (
            f"\nWithout the letters that exclusive propositions rule out: "
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
    for q in range(found["states"]):
        dist = found["dist"][str(q)]
        role = _role(found, q)
        table.add_row(
            str(q),
            role,
            "-" if dist is None else f"{dist:.4g}",
            f"{found['potential'][str(q)]:.2f}",
            ", ".join(pid for pid, taus in found["subtasks"].items() if any(s == q for s, _ in taus)),
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
    """Every edge with one cube of its guard per line, and the sub-tasks that it belongs to."""
    table = _table("Transitions", "q", "q'", "guard", "sub-tasks", right=("q", "q'"))
    for edge in found["edges"]:
        q, target = edge["source"], edge["target"]
        guard = "\n".join(cube_text(tuple(cube)) for cube in edge["guard"])
        owners = [pid for pid, taus in found["subtasks"].items() if [q, target] in taus]
        table.add_row(str(q), str(target), Text(guard), ", ".join(owners), style=None if owners else "dim")
    return table


def _subtasks(found: Inspection) -> Table:
    table = _table("Sub-tasks", "pid", "transitions", "Q_target(q)", right=("transitions",))
    for pid, taus in found["subtasks"].items():
        table.add_row(pid, str(len(taus)), _targets(taus))
    return table


def _targets(taus: Sequence[Sequence[int]]) -> str:
    """``q → {q', ...}`` for every q that a sub-task has a transition out of."""
    targets: Mapping[int, list[int]] = {q: [to for s, to in taus if s == q] for q in sorted({q for q, _ in taus})}
    return "   ".join(f"{q} → {{{', '.join(map(str, to))}}}" for q, to in targets.items())


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}; choose another file") from error
