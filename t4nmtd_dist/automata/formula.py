"""LTLf formulas: syntax tree, parser with error positions, and finite-trace semantics.

The syntax is LTLf2DFA's: ``!`` not, ``&``, ``|``, ``->``, ``<->``, ``X`` strong next, ``WX`` weak next, ``U`` until,
``R`` release, ``F``, ``G``, ``true``, ``false``, ``last``. From loosest to tightest: ``<->``, ``->``, ``|``, ``&``,
``U``, ``R``, unary operators. As there, ``U`` and ``R`` associate to the right, ``->`` to the left, and ``a <-> b <->
c`` means that all three agree.
"""

from __future__ import annotations

import difflib
import functools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import FormulaError

Bools = NDArray[np.bool_]


class Operator(StrEnum):
    """Operator of a syntax tree node; the value is the name of LTLf2DFA's class."""

    TRUE = "LTLfTrue"
    FALSE = "LTLfFalse"
    LAST = "LTLfLast"
    PROPOSITION = "LTLfAtomic"
    NOT = "LTLfNot"
    AND = "LTLfAnd"
    OR = "LTLfOr"
    IMPLIES = "LTLfImplies"
    EQUIVALENT = "LTLfEquivalence"
    NEXT = "LTLfNext"
    WEAK_NEXT = "LTLfWeakNext"
    UNTIL = "LTLfUntil"
    RELEASE = "LTLfRelease"
    EVENTUALLY = "LTLfEventually"
    ALWAYS = "LTLfAlways"


@dataclass(frozen=True, slots=True)
class Formula:
    """A node of the syntax tree.

    Attributes:
        operands: none for constants and propositions, two or more for ``&``, ``|`` and ``<->``, two for ``->``, ``U``
            and ``R``, else one.
        name: the proposition's name, else empty.
    """

    operator: Operator
    operands: tuple[Formula, ...] = ()
    name: str = ""

    def propositions(self) -> frozenset[str]:
        """Names that occur in the formula."""
        if self.operator is Operator.PROPOSITION:
            return frozenset({self.name})
        return frozenset().union(*(operand.propositions() for operand in self.operands))


def names_in_order(text: str) -> tuple[str, ...]:
    """The words of a formula's text in order of first occurrence, operators and constants included."""
    return tuple(dict.fromkeys(re.findall(r"[A-Za-z_]\w*", text)))


def parse(text: str, propositions: Sequence[str] | None = None) -> Formula:
    """Parse a formula.

    Args:
        text: the formula; line breaks are white space.
        propositions: allowed names; None allows any.

    Raises:
        FormulaError: on a syntax error or an unknown proposition, with line, column and a caret.
    """
    formula = _parse(text)
    if propositions is not None:
        for name in sorted(formula.propositions() - set(propositions)):
            raise FormulaError(_unknown(text, name, propositions))
    return formula


def too_deep() -> FormulaError:
    """The error for a formula nested too deeply for the interpreter's stack."""
    return FormulaError("the formula is nested too deeply; expected at most about a hundred nested operators")


def _parse(text: str) -> Formula:
    from lark.exceptions import UnexpectedInput

    try:
        return _converted(_parser()(text))
    except UnexpectedInput as error:
        raise FormulaError(_syntax_message(text, error)) from None
    except RecursionError:
        raise too_deep() from None


@functools.cache
def _parser() -> Any:
    """LTLf2DFA's parser, imported lazily because it loads sympy (half a second)."""
    from ltlf2dfa.parser.ltlf import LTLfParser

    return LTLfParser()


def _converted(node: Any) -> Formula:
    """Convert LTLf2DFA's tree, grouping chains of ``U``, ``R`` and ``->`` in pairs."""
    operator = Operator(type(node).__name__)
    if operator is Operator.PROPOSITION:
        return Formula(operator, name=str(node.s))
    if hasattr(node, "f"):
        return Formula(operator, (_converted(node.f),))
    operands = [_converted(operand) for operand in getattr(node, "formulas", ())]
    if operator in (Operator.UNTIL, Operator.RELEASE):
        return functools.reduce(lambda right, left: Formula(operator, (left, right)), reversed(operands))
    if operator is Operator.IMPLIES:
        return functools.reduce(lambda left, right: Formula(operator, (left, right)), operands)
    return Formula(operator, tuple(operands))


def _unknown(text: str, name: str, propositions: Sequence[str]) -> str:
    found = re.search(rf"(?<![a-z0-9_]){re.escape(name)}(?![a-z0-9_])", text)
    where = _place(text, found.start() if found else 0)
    near = difflib.get_close_matches(name, propositions, n=1)
    guess = f"did you mean {near[0]!r}? " if near else ""
    return f"unknown proposition {name!r}: {guess}declared: {', '.join(propositions) or 'none'}\n{where}"


def _syntax_message(text: str, error: Any) -> str:
    """The full message, with a hint and a caret."""
    token = getattr(error, "token", None)
    at_end = token is not None and token.type == "$END"
    position = len(text.rstrip()) if at_end else int(error.pos_in_stream)
    expected = getattr(error, "allowed", None) or getattr(error, "expected", None) or set()
    if "SYMBOL_NAME" in expected:
        wanted = "a proposition, a constant, a unary operator (! X WX F G) or '('"
    else:
        wanted = "a binary operator (& | -> <-> U R) or " + ("')'" if at_end else "')' or the end")
    came = "the end of the formula" if at_end else repr(str(token) if token is not None else text[position])
    hint = _hint(text, position, at_end and "RSEPARATOR" in expected)
    return f"syntax error: expected {wanted}, found {came}{hint}\n{_place(text, position)}"


def _hint(text: str, position: int, unclosed: bool) -> str:
    """A hint for a recognised mistake, else nothing."""
    if unclosed:
        return "; is a bracket not closed?"
    if re.match(r"[A-Z]", text[position:]):
        return "; names are lower case, and a space or bracket stands between an operator and a name"
    if re.search(r"(?<![a-z0-9_])(last|true|false)$", text[:position], re.IGNORECASE):
        return "; a name must not begin with last, true or false"
    return ""


def _place(text: str, position: int) -> str:
    """Line and column of a position, its line, and a caret."""
    start = text.rfind("\n", 0, position) + 1
    line = text[start:].split("\n", 1)[0]
    blank = re.sub(r"[^\t]", " ", text[start:position])
    return f"line {text.count(chr(10), 0, position) + 1}, column {position - start + 1}:\n  {line}\n  {blank}^"


def satisfies(trace: Sequence[Iterable[str]], formula: Formula) -> bool:
    """Whether a non-empty finite trace of sets of true propositions satisfies a formula.

    Raises:
        ValueError: if the trace is empty.
    """
    if not trace:
        raise ValueError("expected a non-empty trace: LTLf is evaluated at the first position")
    names = sorted(formula.propositions())
    symbols = np.array([sum(1 << names.index(p) for p in set(labels) if p in names) for labels in trace])
    return bool(truth(formula, symbols, names)[0])


def truth(formula: Formula, symbols: NDArray[np.integer[Any]], propositions: Sequence[str]) -> Bools:
    """Truth of a formula at every position of many equally long traces.

    Args:
        formula: its propositions must be among ``propositions``.
        symbols: shape (..., T), T >= 1; bit i of a symbol is set if ``propositions[i]`` holds.
        propositions: names of the bits.

    Returns:
        Bools of shape (..., T): whether the suffix from there satisfies the formula (De Giacomo and Vardi, 2013). A
        trace satisfies the formula if its first position does.
    """
    operator = formula.operator
    if operator is Operator.PROPOSITION:
        return np.asarray((symbols >> propositions.index(formula.name)) & 1, dtype=bool)
    if operator in (Operator.TRUE, Operator.FALSE):
        return np.full(symbols.shape, operator is Operator.TRUE)
    operands = [truth(operand, symbols, propositions) for operand in formula.operands]
    if operator in _BOOLEAN:
        return _boolean(operator, operands)
    return _temporal(operator, operands, symbols.shape)


_BOOLEAN = (Operator.NOT, Operator.AND, Operator.OR, Operator.IMPLIES, Operator.EQUIVALENT)


def _boolean(operator: Operator, operands: list[Bools]) -> Bools:
    match operator:
        case Operator.NOT:
            return ~operands[0]
        case Operator.AND:
            return _all(operands)
        case Operator.OR:
            return ~_all([~values for values in operands])
        case Operator.IMPLIES:
            return ~operands[0] | operands[1]
        case _:
            return _all(operands) | _all([~values for values in operands])


def _all(operands: list[Bools]) -> Bools:
    return np.asarray(np.stack(operands).all(axis=0))


def _temporal(operator: Operator, operands: list[Bools], shape: tuple[int, ...]) -> Bools:
    match operator:
        case Operator.LAST:
            return _shifted(np.zeros(shape, bool), at_end=True)
        case Operator.NEXT:
            return _shifted(operands[0], at_end=False)
        case Operator.WEAK_NEXT:
            return _shifted(operands[0], at_end=True)
        case Operator.EVENTUALLY:
            return _until(np.ones(shape, bool), operands[0])
        case Operator.ALWAYS:
            return ~_until(np.ones(shape, bool), ~operands[0])
        case Operator.UNTIL:
            return _until(*operands)
        case _:
            return ~_until(~operands[0], ~operands[1])


def _shifted(values: Bools, *, at_end: bool) -> Bools:
    """Values of the next position; ``at_end`` at the last one."""
    result = np.full_like(values, at_end)
    result[..., :-1] = values[..., 1:]
    return result


def _until(left: Bools, right: Bools) -> Bools:
    """Strong until, computed backwards."""
    result = right.copy()
    for t in range(right.shape[-1] - 2, -1, -1):
        result[..., t] |= left[..., t] & result[..., t + 1]
    return result
