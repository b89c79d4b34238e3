"""Reduced ordered binary decision diagrams: equal Boolean functions are identical (Bryant, 1986).

A diagram is a number: ``FALSE``, ``TRUE``, or a node that tests its level's variable and branches to ``low`` or
``high``. Levels increase from the root down.
"""

from __future__ import annotations

from t4nmtd_dist.automata.deadline import Deadline

FALSE, TRUE = 0, 1
_TERMINAL_LEVEL = 1 << 30
_CHECK_INTERVAL = 1024


class DiagramStore:
    """Nodes of many diagrams that share sub-diagrams.

    Attributes:
        level: the level each node tests; terminals lie below all levels.
        low: each node's diagram for a false variable.
        high: each node's diagram for a true variable.
    """

    def __init__(self, deadline: Deadline) -> None:
        """Create the terminals; operations raise ``TranslationError`` after the deadline."""
        self.level = [_TERMINAL_LEVEL, _TERMINAL_LEVEL]
        self.low = [FALSE, TRUE]
        self.high = [FALSE, TRUE]
        self._numbers: dict[tuple[int, int, int], int] = {}
        self._choices: dict[tuple[int, int, int], int] = {}
        self._deadline = deadline

    def variable(self, level: int) -> int:
        """The variable of a level, as a function."""
        return self._node(level, FALSE, TRUE)

    def negation(self, f: int) -> int:
        """Not f."""
        return self.choice(f, FALSE, TRUE)

    def conjunction(self, *functions: int) -> int:
        """Conjunction of the functions."""
        result = TRUE
        for f in functions:
            result = self.choice(result, f, FALSE)
        return result

    def disjunction(self, *functions: int) -> int:
        """Disjunction of the functions."""
        result = FALSE
        for f in functions:
            result = self.choice(result, TRUE, f)
        return result

    def choice(self, condition: int, then: int, otherwise: int) -> int:
        """If-then-else, from which all other operations are built."""
        if condition == TRUE or then == otherwise:
            return then
        if condition == FALSE:
            return otherwise
        if then == TRUE and otherwise == FALSE:
            return condition
        key = (condition, then, otherwise)
        known = self._choices.get(key)
        if known is None:
            known = self._choices[key] = self._split(key)
        return known

    def _split(self, key: tuple[int, int, int]) -> int:
        if len(self._choices) % _CHECK_INTERVAL == 0:
            self._deadline.check()
        level = min(self.level[f] for f in key)
        low = self.choice(*(self.low[f] if self.level[f] == level else f for f in key))
        high = self.choice(*(self.high[f] if self.level[f] == level else f for f in key))
        return self._node(level, low, high)

    def _node(self, level: int, low: int, high: int) -> int:
        if low == high:
            return low
        number = self._numbers.setdefault((level, low, high), len(self.level))
        if number == len(self.level):
            self.level.append(level)
            self.low.append(low)
            self.high.append(high)
        return number
