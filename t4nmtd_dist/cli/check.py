"""``t4nmtd check``: does a task's environment meet the requirements of training?"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from t4nmtd_dist.automata.acceptance import ACCEPTANCE_TEXT
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.environments.diagnostics import Diagnosis, diagnose
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.tasks import load_task

USABLE, UNUSABLE = 0, 2


def check(task: str, *, steps: int, seed: int, flags: Sequence[str], as_json: bool) -> int:
    """Run the environment with random actions and report; exit code 0 usable, 2 not.

    Raises:
        T4NMTDError: if the task or its environment cannot be opened, stepped or labelled.
    """
    if steps < 1:
        raise ConfigError(f"--steps {steps}: expected at least one")
    compiled = compile_task(load_task(task, flags=flags))
    found = diagnose(compiled, steps=steps, seed=seed)
    if as_json:
        print(json.dumps(findings(compiled, found), indent=1))
    else:
        _print(Console(), compiled, found)
    return UNUSABLE if found.problems else USABLE


def findings(task: CompiledTask, found: Diagnosis) -> dict[str, Any]:
    """All that ``check`` shows, as JSON data."""
    return {
        "task": task.config.name,
        "usable": not found.problems,
        "problems": found.problems,
        "warnings": found.warnings,
        "environment": found.environment,
        "observation_space": found.observation_space,
        "observation_size": found.observation_size,
        "observations": found.observations.described(),
        "normalised": found.normalised,
        "action_space": found.action_space,
        "algorithm": found.learner.algorithm,
        "snapshots": {
            "adapter": found.snapshots.adapter,
            "bytes": found.snapshots.snapshot_bytes,
            "inexact": dict(found.snapshots.failures),
        },
        "acceptance": task.config.acceptance,
        "automaton": {"states": task.dfa.states, "transitions": len(task.dfa.edges)},
        "subtasks": {pid: len(transitions) for pid, transitions in task.decomposition.subtasks.items()},
        "steps": found.steps,
        "steps_per_s": round(found.steps_per_s, 1),
        "episodes": found.episodes,
        "endings": dict(found.endings),
        "labels": {name: found.true_steps[name] / found.steps for name in found.propositions},
        "never_true": found.never_true,
        "exclusive_violations": [{"together": names, "steps": n} for names, n in found.together.items()],
        "exclusive_suggestions": [asdict(suggestion) for suggestion in found.suggestions],
    }


def _print(console: Console, task: CompiledTask, found: Diagnosis) -> None:
    console.print(Text(f"{task.config.name}: {task.config.title}".removesuffix(": "), style="bold"))
    console.print(_facts(task, found))
    console.print(_labels(task, found))
    for text in found.warnings:
        console.print(Text.assemble(("warning: ", "yellow"), text))
    for suggestion in found.suggestions:
        console.print(Text.assemble(("suggestion: ", "cyan"), suggestion.text(found.steps)))
    for text in found.problems:
        console.print(Text.assemble(("unusable: ", "bold red"), text))
    if not found.problems:
        console.print(Text("usable: nothing stands against training", style="green"))


def _facts(task: CompiledTask, found: Diagnosis) -> Table:
    choice = found.snapshots
    endings = ", ".join(f"{name} {count}" for name, count in sorted(found.endings.items())) or "none yet"
    play = f"{found.steps} steps at {found.steps_per_s:,.0f} a second, {found.episodes} episodes"
    subtasks = ", ".join(f"{pid} ({len(taus)})" for pid, taus in task.decomposition.subtasks.items())
    chosen = task.config.learner.algorithm == "auto"
    rows = {
        "environment": found.environment,
        "observations": f"{found.observation_space}: {_numbers(found)}",
        "actions": found.action_space,
        "algorithm": found.learner.algorithm + (", which these actions call for" if chosen else ""),
        "snapshots": f"restore exactly by {choice.adapter!r}"
        + (f", {choice.snapshot_bytes} bytes" if choice.snapshot_bytes else ""),
        **{f"  not by {adapter!r}": reason for adapter, reason in choice.failures.items()},
        "automaton": f"{task.dfa.states} states, {len(task.dfa.edges)} transitions",
        "acceptance": ACCEPTANCE_TEXT[task.config.acceptance],
        "sub-tasks": f"{subtasks} (transitions of each)",
        "random play": f"{play}: {endings}",
    }
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="cyan", no_wrap=True)
    table.add_column()
    for name, value in rows.items():
        table.add_row(name, Text(value))
    return table


def _numbers(found: Diagnosis) -> str:
    """How many numbers learners observe, and in which form."""
    one_hot = sum(part.size for part in found.observations.parts if part.one_hot)
    size = sum(part.size for part in found.observations.parts)
    told = [f"{size} numbers"]
    told += [f"{one_hot} of them one-hot"] if 0 < one_hot < size else []
    told += ["one-hot"] if one_hot == size else []
    told += [("the others " if one_hot else "") + "normalised by what each learner sees"] if found.normalised else []
    told += ["and the remaining time"] if found.observation_size > size else []
    return ", ".join(told)


def _labels(task: CompiledTask, found: Diagnosis) -> Table:
    table = Table("proposition", "in the formula", "held on", "of steps", box=box.SIMPLE_HEAD)
    for name in found.propositions:
        times = found.true_steps[name]
        style = "" if times else "yellow"
        used = "yes" if name in task.dfa.propositions else "no"
        table.add_row(Text(name), used, str(times), f"{times / found.steps:.2%}", style=style)
    return table
