"""Finds propositions never true together under random actions: candidates for ``exclusive`` groups."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations

from t4nmtd_dist.automata.reduction import ReducedAutomaton, reduce_automaton
from t4nmtd_dist.core.config import AcceptanceSetting
from t4nmtd_dist.method.compiled import CompiledTask

MIN_TRUE = 5
"""Steps on which a proposition must have held to be in a suggestion."""
MOST_SUGGESTIONS = 5
KEEPS_END = (
    "; with it, acceptance = auto may end episodes at the first accepting state; set acceptance to keep it: "
    'acceptance = "end"'
)


@dataclass(frozen=True)
class Suggestion:
    """A group to declare exclusive, if its propositions really cannot hold together.

    Attributes:
        true_steps: steps on which each held.
        expected_together: expected number of steps with a pair if they were independent; if small, seeing none means
            little.
        states_before, transitions_before: of the automaton with the declared groups.
        states, transitions: with this group as well.
        acceptance: of the task with the declared groups.
    """

    group: tuple[str, ...]
    true_steps: Mapping[str, int]
    expected_together: float
    states_before: int
    transitions_before: int
    states: int
    transitions: int
    acceptance: AcceptanceSetting = "first"

    def text(self, steps: int) -> str:
        """The suggestion for display."""
        counts = ", ".join(f"{name} {times}" for name, times in self.true_steps.items())
        return (
            f"{', '.join(self.group[:-1])} and {self.group[-1]} were never true together on {steps} random steps "
            f"({counts} times; independent ones would have met about {self.expected_together:.1f} times): if they "
            f"cannot be, exclusive = {json.dumps([self.group])} makes the automaton smaller ({self.states_before} -> "
            f"{self.states} states, {self.transitions_before} -> {self.transitions} transitions)"
            + (KEEPS_END if self.acceptance == "end" else "")
        )


def suggestions(task: CompiledTask, seen: Mapping[frozenset[str], int]) -> list[Suggestion]:
    """Groups that would shrink the task's automaton, most useful first; ``seen`` counts sets of true propositions."""
    declared = task.config.exclusive
    before = reduce_automaton(task.dfa, declared)
    true = _true_steps(seen)
    found: list[Suggestion] = []
    for group in never_together(task.dfa.propositions, seen, least=MIN_TRUE):
        after = reduce_automaton(task.dfa, [*declared, group])
        if after.accepting and _size(after) != _size(before):
            counts = {name: true[name] for name in group}
            expected = sum(a * b for a, b in combinations(counts.values(), 2)) / sum(seen.values())
            found.append(
                Suggestion(group, counts, round(expected, 2), *_size(before), *_size(after), task.config.acceptance)
            )
    return sorted(found, key=lambda each: (each.states, each.transitions, each.group))[:MOST_SUGGESTIONS]


def never_together(names: Iterable[str], seen: Mapping[frozenset[str], int], *, least: int) -> list[tuple[str, ...]]:
    """Maximal groups of propositions, each true on at least ``least`` steps, of which no two were true in one step."""
    true = _true_steps(seen)
    frequent = [name for name in names if true[name] >= least]
    apart = {
        name: {other for other in frequent if other != name and not any({name, other} <= names for names in seen)}
        for name in frequent
    }
    return sorted(tuple(sorted(group)) for group in _cliques(apart, set(), set(frequent), set()) if len(group) > 1)


def _true_steps(seen: Mapping[frozenset[str], int]) -> Counter[str]:
    true: Counter[str] = Counter()
    for names, times in seen.items():
        true.update(dict.fromkeys(names, times))
    return true


def _cliques(
    apart: Mapping[str, set[str]], group: set[str], candidates: set[str], done: set[str]
) -> Iterator[set[str]]:
    """Maximal cliques that extend ``group`` (Bron and Kerbosch, 1973)."""
    if not candidates and not done:
        yield group
    for name in sorted(candidates):
        yield from _cliques(apart, group | {name}, candidates & apart[name], done & apart[name])
        candidates = candidates - {name}
        done = done | {name}


def _size(reduced: ReducedAutomaton) -> tuple[int, int]:
    return len(reduced.states), len(reduced.transitions)
