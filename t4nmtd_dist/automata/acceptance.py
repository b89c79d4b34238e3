"""When a trace is accepted: at the first accepting state, or at the end of the episode.

A task is *co-safe* if acceptance cannot be lost, so the episode may end at the first accepting state. Any other task
has standard LTLf semantics: the trace ends with the episode. The proposition ``last``, true on the last step, makes
such a task co-safe too, so no other code distinguishes the two.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from t4nmtd_dist.automata.dfa import DFA, MAX_PROPOSITIONS
from t4nmtd_dist.automata.minimise import RawAutomaton, check_size, numbered_dfa
from t4nmtd_dist.automata.reduction import ExclusiveGroups, reduce_automaton
from t4nmtd_dist.core.config import AcceptanceSetting
from t4nmtd_dist.core.errors import FormulaError

Acceptance = Literal["first", "end"]

LAST = "last"
ACCEPTANCE_TEXT: dict[str, str] = {
    "first": "at the first accepting state, which ends the episode",
    "end": "at the end of the episode (the proposition last): acceptance can be lost again before it",
}


def acceptance_of(dfa: DFA, exclusive: ExclusiveGroups = ()) -> Acceptance:
    """``first`` if the task is co-safe: no symbol allowed by ``exclusive`` leads out of the accepting states."""
    reduced = reduce_automaton(dfa, exclusive)
    lost = any(q in reduced.accepting and target not in reduced.accepting for q, target in reduced.transitions)
    return "end" if lost else "first"


def task_automaton(
    dfa: DFA, setting: AcceptanceSetting = "auto", exclusive: ExclusiveGroups = ()
) -> tuple[DFA, Acceptance]:
    """The automaton to train with, and how it accepts; ``auto`` applies ``acceptance_of``.

    Raises:
        FormulaError: if adding ``last`` exceeds the maximum number of propositions.
        TranslationError: if the automaton becomes too large.
    """
    acceptance = acceptance_of(dfa, exclusive) if setting == "auto" else setting
    return (with_last(dfa) if acceptance == "end" else dfa), acceptance


def with_last(dfa: DFA) -> DFA:
    """An automaton that accepts on the step with ``last`` if ``dfa`` accepts the trace up to it.

    Otherwise that step leads to an error state, as irreparable violations already do. States stay separate even if
    ``last`` makes them equivalent, because sub-tasks aim at states in which the formula holds. Only an initial state
    without incoming transitions is removed, if another has the same future.

    Raises:
        FormulaError: if adding ``last`` exceeds the maximum number of propositions.
        TranslationError: if the automaton becomes too large.
    """
    if len(dfa.propositions) >= MAX_PROPOSITIONS:
        raise FormulaError(
            f"the formula has {len(dfa.propositions)} propositions, and its acceptance can be lost again; expected at "
            f"most {MAX_PROPOSITIONS - 1}, since {LAST!r} (the end of the episode) is one more"
        )
    names = tuple(sorted((*dfa.propositions, LAST)))
    check_size(dfa.states + 2, len(names))
    symbols = np.arange(1 << len(names))
    holds = {name: symbols >> bit & 1 for bit, name in enumerate(names)}
    read = sum((holds[name] << bit for bit, name in enumerate(dfa.propositions)), start=np.zeros_like(symbols))
    accepted, failed = dfa.states, min(dfa.error, default=dfa.states + 1)
    delta = np.empty((dfa.states + 2, len(symbols)), np.int32)
    delta[dfa.states], delta[dfa.states + 1] = accepted, failed
    moved = dfa.delta[:, read]
    ended = np.where(np.isin(moved, list(dfa.accepting)), accepted, failed)
    delta[: dfa.states] = np.where(holds[LAST] > 0, ended, moved)
    accepting = np.arange(dfa.states + 2) == accepted
    return numbered_dfa(names, RawAutomaton(delta, accepting, _without_fresh_initial(dfa)))


def _without_fresh_initial(dfa: DFA) -> int:
    """A start state with the initial state's future."""
    if (dfa.delta == dfa.initial).any():
        return dfa.initial
    alike = np.flatnonzero((dfa.delta == dfa.delta[dfa.initial]).all(axis=1))
    return int(alike[-1])


def unfulfilled_states(dfa: DFA) -> frozenset[int]:
    """States of a ``with_last`` automaton in which waiting until the end is not enough; empty for others."""
    if LAST not in dfa.propositions:
        return frozenset()
    bit = dfa.symbol([LAST])
    symbols = np.flatnonzero(np.arange(dfa.delta.shape[1]) & bit == 0)
    waits = dfa.delta[:, symbols] == np.arange(dfa.states)[:, None]
    accepted = np.isin(dfa.delta[:, symbols | bit], list(dfa.accepting))
    return frozenset(map(int, np.flatnonzero(~(waits & accepted).any(axis=1)))) - dfa.accepting
