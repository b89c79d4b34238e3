"""When a trace is accepted: at the first accepting state, or where the episode ends.

A task is *co-safe* if acceptance cannot be lost again: the episode may then end at the first accepting state. Any other
task has LTLf's own meaning, under which the trace ends with the episode. The proposition ``last``, true on the last
step of an episode, makes such a task co-safe as well, so that nothing else needs to know of the difference.
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
    """``first`` if the task is co-safe, which it is if no allowed symbol leads out of the accepting states.

    Args:
        dfa: the automaton of the formula.
        exclusive: groups of propositions that can never hold together; their symbols do not count.
    """
    reduced = reduce_automaton(dfa, exclusive)
    lost = any(q in reduced.accepting and target not in reduced.accepting for q, target in reduced.transitions)
    return "end" if lost else "first"


def task_automaton(
    dfa: DFA, setting: AcceptanceSetting = "auto", exclusive: ExclusiveGroups = ()
) -> tuple[DFA, Acceptance]:
    """The automaton that a task is trained with, and how it accepts.

    Args:
        dfa: the automaton of the formula.
        setting: ``auto`` decides by ``acceptance_of``.
        exclusive: as for ``acceptance_of``.

    Raises:
        FormulaError: if there is no room for ``last``.
        TranslationError: if the automaton becomes too large.
    """
    acceptance = acceptance_of(dfa, exclusive) if setting == "auto" else setting
    return (with_last(dfa) if acceptance == "end" else dfa), acceptance


def with_last(dfa: DFA) -> DFA:
    """The automaton that accepts on the step on which ``last`` holds, where ``dfa`` accepts the trace up to it.

    Where ``dfa`` does not, that step leads to an error state; so does, as before, a violation that cannot be mended.
    The states of ``dfa`` stay apart, also where ``last`` makes them equivalent: which of them the formula holds in is
    what sub-tasks aim at. Only an initial state that no transition enters goes, if another state has the same future.

    Raises:
        FormulaError: if there is no room for ``last``.
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
    """A state to start in that has the initial state's future: it does not matter what accepts the empty trace."""
    if (dfa.delta == dfa.initial).any():
        return dfa.initial
    alike = np.flatnonzero((dfa.delta == dfa.delta[dfa.initial]).all(axis=1))
    return int(alike[-1])


def unfulfilled_states(dfa: DFA) -> frozenset[int]:
    """Of a ``with_last`` automaton, the states in which waiting until the end is not enough; none of any other."""
    if LAST not in dfa.propositions:
        return frozenset()
    bit = dfa.symbol([LAST])
    symbols = np.flatnonzero(np.arange(dfa.delta.shape[1]) & bit == 0)
    waits = dfa.delta[:, symbols] == np.arange(dfa.states)[:, None]
    accepted = np.isin(dfa.delta[:, symbols | bit], list(dfa.accepting))
    return frozenset(map(int, np.flatnonzero(~(waits & accepted).any(axis=1)))) - dfa.accepting
