"""Reduced ordered binary decision diagrams: boolean functions in a form in which equal means identical.

A diagram is a number: ``FALSE``, ``TRUE``, or a node that tests the variable of some level and goes on at
``low`` or ``high``. Levels grow from the root down (Bryant, 1986).
"""

from __future__ import annotations

from t4nmtd_dist.automata.deadline import Deadline

FALSE, TRUE = 0, 1
_TERMINAL_LEVEL = 1 << 30
_CHECK_INTERVAL = 1024


class DiagramStore:
    """The nodes of many diagrams that share their parts.

    Attributes:
        level: of each node, the level that it tests; terminals lie below every level.
        low: of each node, the diagram for a false variable.
        high: of each node, the diagram for a true variable.
    """

    def __init__(self, deadline: Deadline) -> None:
        """Start with the terminals; operations raise ``TranslationError`` once the deadline has passed."""
        self.level = [_TERMINAL_LEVEL, _TERMINAL_LEVEL]
        self.low = [FALSE, TRUE]
        self.high = [FALSE, TRUE]
        self._numbers: dict[tuple[int, int, int], int] = {}
        self._choices: dict[tuple[int, int, int], int] = {}
        self._deadline = deadline

    def variable(self, level: int) -> int:
        """The function that is the variable of a level."""
        return self._node(level, FALSE, TRUE)

    def negation(self, f: int) -> int:
        """Not f."""
        return self.choice(f, FALSE, TRUE)

    def conjunction(self, *functions: int) -> int:
        """All of the functions."""
        result = TRUE
        for f in functions:
            result = self.choice(result, f, FALSE)
        return result

    def disjunction(self, *functions: int) -> int:
        """Any of the functions."""
        result = FALSE
        for f in functions:
            result = self.choice(result, TRUE, f)
        return result

    def choice(self, condition: int, then: int, otherwise: int) -> int:
        """``then`` where ``condition`` holds, else ``otherwise``: from this, all else is made."""
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
