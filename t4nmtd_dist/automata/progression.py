"""LTLf to automaton in pure Python: formula progression on binary decision diagrams.

A state is a Boolean function of *obligations* "there is a next position and psi holds there". A formula unfolds into a
Boolean function of current propositions and obligations: phi U psi = psi | (phi & X(phi U psi)). Diagrams test
propositions first, so a state's successors are the sub-diagrams below the propositions: one per distinct residual, not
per symbol. Equal functions are one diagram and a formula has finitely many obligations, so the search terminates.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.bdd import FALSE, TRUE, DiagramStore
from t4nmtd_dist.automata.deadline import Deadline
from t4nmtd_dist.automata.formula import Formula, Operator
from t4nmtd_dist.automata.minimise import RawAutomaton, check_size

_TRUE_FORMULA = Formula(Operator.TRUE)


def translate_by_progression(formula: Formula, propositions: Sequence[str], deadline: Deadline) -> RawAutomaton:
    """A formula's complete deterministic automaton; states are classes of equivalent residual formulas.

    Arguments as for ``mona.translate_by_mona``.

    Raises:
        TranslationError: if the deadline passes or the transition table becomes too large.
    """
    unfolding = _Unfolding(propositions, deadline)
    initial = unfolding.obligation(formula)
    states, number, rows = [initial], {initial: 0}, []
    for state in states:
        deadline.check()
        check_size(len(states), len(propositions))
        residuals, inverse = np.unique(unfolding.successors(state), return_inverse=True)
        for residual in residuals.tolist():
            if number.setdefault(residual, len(states)) == len(states):
                states.append(residual)
        rows.append(np.array([number[r] for r in residuals.tolist()], dtype=np.int32)[inverse])
    accepting = np.array([unfolding.holds_at_end(state) for state in states])
    return RawAutomaton(np.stack(rows), accepting, 0)


class _Unfolding:
    """Formulas as diagrams; propositions have the upper levels, obligations the lower."""

    def __init__(self, propositions: Sequence[str], deadline: Deadline) -> None:
        self._diagrams = DiagramStore(deadline)
        self._width = len(propositions)
        # The last proposition is tested first: it is the highest bit of a symbol.
        self._levels = {name: self._width - 1 - i for i, name in enumerate(propositions)}
        self._obliged: list[Formula] = []
        self._obligations: dict[Formula, int] = {}
        self._unfolded: dict[Formula, int] = {}
        self._progressed = {FALSE: FALSE, TRUE: TRUE}

    def obligation(self, formula: Formula) -> int:
        """Diagram of: there is a next position, and the formula holds there."""
        if formula not in self._obligations:
            self._obligations[formula] = self._diagrams.variable(self._width + len(self._obliged))
            self._obliged.append(formula)
        return self._obligations[formula]

    def successors(self, state: int) -> NDArray[np.int64]:
        """Residual diagram after each symbol, shape (2**|AP|,)."""
        return self._by_symbol(self._progress(state), 0)

    def holds_at_end(self, state: int) -> bool:
        """Whether a trace may end in a state, with all obligations false."""
        while state not in (FALSE, TRUE):
            state = self._diagrams.low[state]
        return state == TRUE

    def _progress(self, state: int) -> int:
        """Replace a state's obligations with the unfoldings of their formulas."""
        if state not in self._progressed:
            d = self._diagrams
            condition = self._unfold(self._obliged[d.level[state] - self._width])
            self._progressed[state] = d.choice(condition, self._progress(d.high[state]), self._progress(d.low[state]))
        return self._progressed[state]

    def _by_symbol(self, node: int, level: int) -> NDArray[np.int64]:
        if self._diagrams.level[node] >= self._width:
            return np.full(1 << (self._width - level), node)
        low, high = node, node
        if self._diagrams.level[node] == level:
            low, high = self._diagrams.low[node], self._diagrams.high[node]
        below = self._by_symbol(low, level + 1)
        return np.concatenate([below, below if high == low else self._by_symbol(high, level + 1)])

    def _unfold(self, formula: Formula) -> int:
        if formula not in self._unfolded:
            self._unfolded[formula] = self._unfold_operator(formula)
        return self._unfolded[formula]

    def _unfold_operator(self, formula: Formula) -> int:
        d, operands = self._diagrams, formula.operands
        match formula.operator:
            case Operator.TRUE:
                return TRUE
            case Operator.FALSE:
                return FALSE
            case Operator.PROPOSITION:
                return d.variable(self._levels[formula.name])
            case Operator.LAST:
                return d.negation(self.obligation(_TRUE_FORMULA))
            case Operator.NEXT:
                return self.obligation(operands[0])
            case Operator.WEAK_NEXT:
                return self._weak_obligation(operands[0])
            case _:
                return self._unfold_compound(formula, [self._unfold(operand) for operand in operands])

    def _unfold_compound(self, formula: Formula, parts: list[int]) -> int:
        d = self._diagrams
        match formula.operator:
            case Operator.NOT:
                return d.negation(parts[0])
            case Operator.AND:
                return d.conjunction(*parts)
            case Operator.OR:
                return d.disjunction(*parts)
            case Operator.IMPLIES:
                return d.choice(parts[0], parts[1], TRUE)
            case Operator.EQUIVALENT:
                return d.choice(d.conjunction(*parts), TRUE, d.negation(d.disjunction(*parts)))
            case Operator.EVENTUALLY:
                return d.disjunction(parts[0], self.obligation(formula))
            case Operator.ALWAYS:
                return d.conjunction(parts[0], self._weak_obligation(formula))
            case Operator.UNTIL:
                return d.disjunction(parts[1], d.conjunction(parts[0], self.obligation(formula)))
            case _:
                return d.conjunction(parts[1], d.disjunction(parts[0], self._weak_obligation(formula)))

    def _weak_obligation(self, formula: Formula) -> int:
        """Diagram of: the formula holds at the next position, if any."""
        return self._diagrams.negation(self.obligation(Formula(Operator.NOT, (formula,))))
