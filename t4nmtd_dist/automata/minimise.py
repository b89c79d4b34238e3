"""Converts a complete deterministic automaton to the canonical DFA of its non-empty traces."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.deadline import Deadline
from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.errors import TranslationError

MAX_ENTRIES = 1 << 25
"""Most entries of a transition table, states times symbols (128 MiB)."""


class RawAutomaton(NamedTuple):
    """A translator's result: complete and deterministic, in no particular form.

    Attributes:
        delta: int32, shape (states, 2**propositions); symbols as in ``DFA``.
        accepting: bool, shape (states,).
        initial: the state before the first symbol; may accept or not.
    """

    delta: NDArray[np.int32]
    accepting: NDArray[np.bool_]
    initial: int


def check_size(states: int, propositions: int) -> None:
    """Reject a transition table that is too large.

    Raises:
        TranslationError: if it has more than ``MAX_ENTRIES`` entries.
    """
    if states << propositions > MAX_ENTRIES:
        raise TranslationError(
            f"the automaton has {states} states or more over {1 << propositions} symbols; expected at most "
            f"{MAX_ENTRIES} entries in its transition table: give a simpler formula or fewer propositions"
        )


def canonical_dfa(propositions: tuple[str, ...], automaton: RawAutomaton, deadline: Deadline) -> DFA:
    """The minimal complete DFA of the non-empty traces, with states in breadth-first order.

    Raises:
        TranslationError: if the deadline passes.
    """
    delta, accepting = _with_fresh_initial(automaton)
    columns, symbol_class = _unique(delta.T)
    classes = np.ascontiguousarray(columns.T)
    block = _refined(classes, accepting, deadline)
    first = np.unique(block, return_index=True)[1]
    quotient = block[classes[first]]
    order = _breadth_first(quotient[:, symbol_class], int(block[0]))
    rank = np.full(len(first), -1)
    rank[order] = np.arange(len(order))
    table = rank[quotient[order]][:, symbol_class].astype(np.int32)
    accepted = np.flatnonzero(accepting[first[order]])
    return DFA(propositions, np.ascontiguousarray(table), frozenset(int(q) for q in accepted))


def numbered_dfa(propositions: tuple[str, ...], automaton: RawAutomaton) -> DFA:
    """The reachable states of an automaton in breadth-first order; merges none."""
    order = _breadth_first(automaton.delta, automaton.initial)
    rank = np.full(len(automaton.delta), -1, np.int32)
    rank[order] = np.arange(len(order))
    accepted = np.flatnonzero(automaton.accepting[order])
    return DFA(propositions, np.ascontiguousarray(rank[automaton.delta[order]]), frozenset(map(int, accepted)))


def _with_fresh_initial(automaton: RawAutomaton) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Prepend a new, non-accepting initial state 0 without incoming transitions."""
    delta = np.concatenate([automaton.delta[[automaton.initial]], automaton.delta]) + np.int32(1)
    return delta, np.concatenate([[False], automaton.accepting])


def _unique(rows: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.int32]]:
    """Distinct rows by first occurrence, and each row's index among them."""
    numbers: dict[bytes, int] = {}
    inverse = np.array(
        [numbers.setdefault(row.tobytes(), len(numbers)) for row in np.ascontiguousarray(rows)],
        dtype=np.int32,
    )
    first = np.unique(inverse, return_index=True)[1]
    return rows[first], inverse


def _refined(delta: NDArray[np.int32], accepting: NDArray[np.bool_], deadline: Deadline) -> NDArray[np.int32]:
    """Moore's partition refinement: states of a block accept the same suffixes."""
    block = _unique(accepting[:, None])[1]
    while True:
        deadline.check()
        finer = _unique(np.concatenate([block[:, None], block[delta]], axis=1))[1]
        if finer.max() == block.max():
            return block
        block = finer


def _breadth_first(delta: NDArray[Any], initial: int) -> list[int]:
    """States in breadth-first order from ``initial``, symbols ascending."""
    order, seen = [initial], {initial}
    for q in order:
        targets, first = np.unique(delta[q], return_index=True)
        for target in targets[np.argsort(first)].tolist():
            if target not in seen:
                seen.add(target)
                order.append(target)
    return order
