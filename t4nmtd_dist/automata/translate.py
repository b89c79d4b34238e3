"""Translates LTLf text to its canonical DFA."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np

from t4nmtd_dist.automata.deadline import Deadline
from t4nmtd_dist.automata.dfa import DFA, MAX_PROPOSITIONS
from t4nmtd_dist.automata.formula import Formula, parse, too_deep
from t4nmtd_dist.automata.minimise import RawAutomaton, canonical_dfa
from t4nmtd_dist.automata.mona import find_mona, translate_by_mona
from t4nmtd_dist.automata.progression import translate_by_progression
from t4nmtd_dist.core.errors import ConfigError, FormulaError

Translator = Literal["auto", "mona", "python"]


def translate(
    formula: str,
    *,
    propositions: Sequence[str] | None = None,
    translator: Translator = "auto",
    time_limit: float = 30.0,
    deadline: Deadline | None = None,
) -> DFA:
    """The minimal complete DFA of a formula over non-empty traces, independent of the translator.

    Args:
        formula: LTLf in LTLf2DFA's syntax (see ``t4nmtd_dist.automata.formula``).
        propositions: allowed names; None allows any. The DFA has those that occur, sorted.
        translator: ``mona``, ``python``, or ``auto``: MONA if installed, else Python.
        time_limit: timeout in seconds, without parsing.
        deadline: replaces ``time_limit`` within a compilation.

    Raises:
        FormulaError: on a syntax error, an unknown proposition, over 16 propositions, or an unsatisfiable or valid
            formula.
        TranslationError: if a requested MONA is missing, or a time or size limit is exceeded.
        ConfigError: on an unknown translator or a non-positive time limit.
    """
    if translator not in get_args(Translator):
        raise ConfigError(f"translator: expected one of {', '.join(get_args(Translator))}, got {translator!r}")
    tree = parse(formula, propositions)
    names = tuple(sorted(tree.propositions()))
    if len(names) > MAX_PROPOSITIONS:
        raise FormulaError(f"the formula has {len(names)} propositions; expected at most {MAX_PROPOSITIONS}")
    deadline = deadline or Deadline.after(time_limit)
    try:
        dfa = canonical_dfa(names, _automaton(tree, names, translator, deadline), deadline)
    except RecursionError:
        raise too_deep() from None
    _refuse_trivial(dfa)
    return dfa


def _automaton(tree: Formula, names: Sequence[str], translator: Translator, deadline: Deadline) -> RawAutomaton:
    if translator == "mona" or (translator == "auto" and find_mona() is not None):
        return translate_by_mona(tree, names, deadline)
    return translate_by_progression(tree, names, deadline)


def _refuse_trivial(dfa: DFA) -> None:
    if not dfa.accepting:
        raise FormulaError("the formula is unsatisfiable: no trace satisfies it, so the task could never succeed")
    if dfa.accepting.issuperset(np.unique(dfa.delta).tolist()):
        raise FormulaError("the formula is valid: every trace satisfies it, so the task would be done at once")
