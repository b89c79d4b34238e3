"""Removes the symbols that exclusive propositions rule out from a task automaton."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from t4nmtd_dist.automata.cubes import TruthTable
from t4nmtd_dist.automata.dfa import DFA

Transition = tuple[int, int]
ExclusiveGroups = Sequence[Sequence[str]]


@dataclass(frozen=True)
class ReducedAutomaton:
    """A DFA restricted to allowed symbols; states keep the DFA's numbers.

    Attributes:
        states: states reachable from the initial state.
        transitions: their (source, target) pairs, sorted, with self-loops and transitions into error states.
        accepting: the reachable part of F.
        error: E, the reachable states that cannot reach F.
    """

    states: frozenset[int]
    transitions: tuple[Transition, ...]
    accepting: frozenset[int]
    error: frozenset[int]

    @property
    def progress(self) -> tuple[Transition, ...]:
        """Transitions a sub-task may aim at: no self-loops, none out of F, none into E."""
        return tuple(
            (q, target)
            for q, target in self.transitions
            if q != target and q not in self.accepting and target not in self.error
        )

    @property
    def failures(self) -> tuple[Transition, ...]:
        """The transitions into E from a state that is neither in F nor in E."""
        ended = self.accepting | self.error
        return tuple((q, target) for q, target in self.transitions if q not in ended and target in self.error)


def allowed_symbols(dfa: DFA, exclusive: ExclusiveGroups = ()) -> TruthTable:
    """Symbols with at most one proposition of each exclusive group, bool (2**|AP|,)."""
    symbols = np.arange(1 << len(dfa.propositions))
    allowed = np.ones(symbols.size, dtype=np.bool_)
    for group in exclusive:
        bits = [dfa.symbol([name]) for name in set(group)]
        allowed &= sum(((symbols & bit) > 0).astype(np.int64) for bit in bits) <= 1
    return allowed


def reduce_automaton(dfa: DFA, exclusive: ExclusiveGroups = ()) -> ReducedAutomaton:
    """Remove the symbols ruled out by ``exclusive`` and the states that become unreachable."""
    delta = dfa.delta[:, allowed_symbols(dfa, exclusive)]
    successors = {q: set(map(int, np.unique(delta[q]))) for q in range(dfa.states)}
    states = closure([dfa.initial], successors)
    transitions = tuple((q, target) for q in sorted(states) for target in sorted(successors[q]))
    accepting = dfa.accepting & states
    alive = closure(accepting, predecessors(transitions))
    return ReducedAutomaton(states, transitions, accepting, states - alive)


def closure(start: Iterable[int], successors: dict[int, set[int]]) -> frozenset[int]:
    """States reachable from ``start``, itself included."""
    found = set(start)
    frontier = list(found)
    while frontier:
        fresh = successors.get(frontier.pop(), set()) - found
        found |= fresh
        frontier.extend(fresh)
    return frozenset(found)


def shortest_distances(
    transitions: Iterable[Transition], targets: Iterable[int], unfulfilled: Collection[int] = ()
) -> dict[int, float]:
    """Number of transitions to the nearest target, for all states that reach one.

    A transition into a target from an ``unfulfilled`` state counts as two (``automata.acceptance``).
    """
    sources = predecessors(transitions)
    dist = dict.fromkeys(targets, 0.0)
    goals, fresh = frozenset(dist), set(dist)
    while fresh:
        nearer = set()
        for target in fresh:
            for q in sources.get(target, ()):
                length = dist[target] + (2.0 if target in goals and q in unfulfilled else 1.0)
                if length < dist.get(q, math.inf):
                    dist[q] = length
                    nearer.add(q)
        fresh = nearer
    return dist


def predecessors(transitions: Iterable[Transition]) -> dict[int, set[int]]:
    """Set of sources by target."""
    sources: dict[int, set[int]] = {}
    for q, target in transitions:
        sources.setdefault(target, set()).add(q)
    return sources
