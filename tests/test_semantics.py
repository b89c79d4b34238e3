"""The meaning of LTLf: textbook definition, vectorised evaluation and both translators say the same."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.automata.formula import Formula, Operator, parse, satisfies, truth
from t4nmtd_dist.automata.mona import find_mona
from t4nmtd_dist.automata.translate import Translator, translate
from t4nmtd_dist.core.errors import FormulaError

NAMES = ("a", "b", "c")
ALL_TRACES = {length: np.array(list(itertools.product(range(8), repeat=length))) for length in (1, 2, 3, 4)}

needs_mona = pytest.mark.skipif(find_mona() is None, reason="the program mona is not installed")


def formula_texts() -> st.SearchStrategy[str]:
    """Random formulas over a, b and c with every operator of the syntax."""
    leaves = st.sampled_from([*NAMES, *NAMES, "true", "false", "last"])

    def extend(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
        unary = st.builds("{}({})".format, st.sampled_from(["!", "X", "WX", "F", "G"]), inner)
        operators = st.sampled_from([" & ", " | ", " -> ", " <-> ", " U ", " R "])
        parts = st.lists(inner.map("({})".format), min_size=2, max_size=3)
        return unary | st.builds(lambda operator, operands: operator.join(operands), operators, parts)

    return st.recursive(leaves, extend, max_leaves=8)


def holds(formula: Formula, trace: list[frozenset[str]], i: int) -> bool:
    """The definition (De Giacomo and Vardi, 2013), word for word."""
    later = range(i, len(trace))

    def at(operand: int, j: int) -> bool:
        return holds(formula.operands[operand], trace, j)

    everyone = [holds(operand, trace, i) for operand in formula.operands]
    meaning: dict[Operator, Callable[[], bool]] = {
        Operator.TRUE: lambda: True,
        Operator.FALSE: lambda: False,
        Operator.LAST: lambda: i == len(trace) - 1,
        Operator.PROPOSITION: lambda: formula.name in trace[i],
        Operator.NOT: lambda: not everyone[0],
        Operator.AND: lambda: all(everyone),
        Operator.OR: lambda: any(everyone),
        Operator.IMPLIES: lambda: everyone[1] or not everyone[0],
        Operator.EQUIVALENT: lambda: len(set(everyone)) == 1,
        Operator.NEXT: lambda: i + 1 < len(trace) and at(0, i + 1),
        Operator.WEAK_NEXT: lambda: i + 1 == len(trace) or at(0, i + 1),
        Operator.EVENTUALLY: lambda: any(at(0, j) for j in later),
        Operator.ALWAYS: lambda: all(at(0, j) for j in later),
        Operator.UNTIL: lambda: any(at(1, j) and all(at(0, k) for k in range(i, j)) for j in later),
        Operator.RELEASE: lambda: all(at(1, j) or any(at(0, k) for k in range(i, j)) for j in later),
    }
    return meaning[formula.operator]()


def accepted(dfa: DFA, symbols: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which traces of symbols over NAMES, shape (traces, length), a DFA accepts."""
    own = np.zeros_like(symbols)
    for i, name in enumerate(dfa.propositions):
        own |= ((symbols >> NAMES.index(name)) & 1) << i
    q = np.full(len(symbols), dfa.initial)
    for t in range(symbols.shape[1]):
        q = dfa.delta[q, own[:, t]]
    return np.isin(q, list(dfa.accepting))


def satisfying(text: str) -> dict[int, NDArray[np.bool_]]:
    """For each length, which of all traces satisfy a formula by direct evaluation."""
    formula = parse(text, NAMES)
    return {length: truth(formula, traces, NAMES)[:, 0] for length, traces in ALL_TRACES.items()}


def translated(text: str, translator: Translator) -> DFA | str:
    try:
        return translate(text, translator=translator)
    except FormulaError as error:
        return str(error)


def check_against_semantics(text: str, result: DFA | str) -> None:
    models = satisfying(text)
    if isinstance(result, str):
        constant = {bool(value) for values in models.values() for value in np.unique(values)}
        assert constant == {"valid" in result}
        return
    for length, expected in models.items():
        np.testing.assert_array_equal(accepted(result, ALL_TRACES[length]), expected)


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(formula_texts())
@example("a -> b -> c")
@example("(a <-> b <-> c)")
@example("X(a) -> !(last)")
def test_python_automaton_accepts_exactly_the_models(text: str) -> None:
    check_against_semantics(text, translated(text, "python"))


@needs_mona
@settings(max_examples=300, deadline=None)
@given(formula_texts())
@example("a -> b -> c")
@example("X(a) <-> WX(b) <-> last")
@example("!(last) & (a R b R c)")
@pytest.mark.slow
def test_mona_and_python_build_the_same_automaton(text: str) -> None:
    by_mona, by_python = translated(text, "mona"), translated(text, "python")
    assert by_mona == by_python
    check_against_semantics(text, by_mona)


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(formula_texts(), st.lists(st.frozensets(st.sampled_from(NAMES)), min_size=1, max_size=5))
def test_evaluation_follows_the_definition(text: str, trace: list[frozenset[str]]) -> None:
    formula = parse(text)
    assert satisfies(trace, formula) == holds(formula, trace, 0)


@pytest.mark.parametrize(
    ("text", "trace", "expected"),
    [
        ("X true", [{"a"}], False),
        ("WX false", [{"a"}], True),
        ("last", [set(), set()], False),
        ("a U b", [{"a"}, {"a"}, {"b"}], True),
        ("a U b", [{"a"}, {"a"}], False),
        ("b R a", [{"a"}, {"a"}], True),
        ("b R a", [{"a"}, {"a", "b"}, set()], True),
        ("b R a", [{"a"}, {"b"}], False),
        ("G a", [{"a"}, {"a"}], True),
        ("F(a & X b)", [{"a"}, {"a"}, {"b"}], True),
        ("F(a & X b)", [{"a", "b"}], False),
        ("a -> b -> c", [set()], False),
        ("a <-> b <-> c", [{"c"}], False),
        ("a U b U c", [{"a"}, {"b"}, {"c"}], True),
        ("a & b U c", [{"b"}, {"c"}], False),
    ],
)
def test_meaning_of_each_operator(text: str, trace: list[set[str]], expected: bool) -> None:
    assert satisfies(trace, parse(text)) is expected


def test_an_empty_trace_is_refused() -> None:
    with pytest.raises(ValueError, match="non-empty"):
        satisfies([], parse("a"))


@given(formula_texts())
@settings(max_examples=50, deadline=None)
def test_the_initial_state_is_never_accepting_nor_entered(text: str) -> None:
    result = translated(text, "python")
    if isinstance(result, DFA):
        assert result.initial == 0
        assert 0 not in result.accepting


@given(formula_texts(), formula_texts())
@settings(max_examples=100, deadline=None)
def test_equivalent_formulas_have_equal_automata(left: str, right: str) -> None:
    """De Morgan's laws: different texts of one language over the same propositions."""
    conjunction = translated(f"({left}) & ({right})", "python")
    assert conjunction == translated(f"!(!({right}) | !({left}))", "python")


@given(formula_texts())
@settings(max_examples=50, deadline=None)
def test_states_are_numbered_breadth_first_and_differ(text: str) -> None:
    result = translated(text, "python")
    if isinstance(result, str):
        return
    first_seen = list(dict.fromkeys([0, *result.delta.ravel().tolist()]))
    assert first_seen == list(range(result.states))
    assert len({(q in result.accepting, result.delta[q].tobytes()) for q in range(result.states)}) == result.states
