"""High level: a table Q(q, sub-task) and the choice E(Q, q) (paper, Algorithm 1 and section "High level")."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence

import numpy as np

from t4nmtd_dist.method.decomposition import Decomposition

QEntries = list[tuple[int, str, float]]


class QTable:
    """Q(q, T) for every DFA state q and sub-task T available there; unknown entries are -inf.

    Args:
        decomposition: which sub-tasks are available in which state.
        terminal: states of value 0 (F and E).
        alpha: step size.
        gamma: discount per decision, or per environment step with ``smdp_discount``.
        epsilon: share of uniform choices in ``choose``.
    """

    def __init__(
        self,
        decomposition: Decomposition,
        terminal: Iterable[int],
        *,
        alpha: float = 0.1,
        gamma: float = 0.99,
        epsilon: float = 0.1,
        smdp_discount: bool = False,
    ) -> None:
        self._decomposition = decomposition
        self._terminal = frozenset(terminal)
        self._alpha, self._gamma, self._epsilon = alpha, gamma, epsilon
        self._smdp_discount = smdp_discount
        self._values: dict[tuple[int, str], float] = {}

    def value(self, q: int, pid: str) -> float:
        """Q(q, pid), -inf if unknown."""
        return self._values.get((q, pid), -math.inf)

    def best(self, q: int) -> float:
        """Max over sub-tasks of Q(q, .); 0 in F and E and if all are unknown."""
        if q in self._terminal:
            return 0.0
        known = [self.value(q, pid) for pid in self._decomposition.available(q)]
        best = max(known, default=-math.inf)
        return best if best > -math.inf else 0.0

    def update(self, q: int, pid: str, reward: float, q_next: int, steps: int = 1) -> None:
        """Learn from learner ``pid``'s DFA change q -> q_next with shaped reward ``reward``."""
        discount = self._gamma**steps if self._smdp_discount else self._gamma
        self._move(q, pid, reward + discount * self.best(q_next))

    def fail(self, q: int, pid: str) -> None:
        """Learn from an attempt that reached no target: a step towards 0."""
        self._move(q, pid, 0.0)

    def _move(self, q: int, pid: str, target: float) -> None:
        old = self._values.get((q, pid))
        self._values[q, pid] = target if old is None else old + self._alpha * (target - old)

    def choose(self, q: int, rng: np.random.Generator, among: Collection[str] | None = None) -> str | None:
        """E(Q, q): epsilon-greedy over the sub-tasks available in q (and in ``among``), random ties; None if none."""
        available = self._available(q, among)
        if not available:
            return None
        if rng.random() < self._epsilon:
            return available[int(rng.integers(len(available)))]
        best = max(self.value(q, pid) for pid in available)
        ties = [pid for pid in available if self.value(q, pid) == best]
        return ties[int(rng.integers(len(ties)))]

    def greedy(self, q: int, among: Collection[str] | None = None) -> str | None:
        """Arg max Q(q, .), ties by name, for evaluation; None if no sub-task (of ``among``) is available."""
        return max(self._available(q, among), key=lambda pid: self.value(q, pid), default=None)

    def _available(self, q: int, among: Collection[str] | None) -> Sequence[str]:
        available = self._decomposition.available(q)
        return available if among is None else [pid for pid in available if pid in among]

    def entries(self) -> QEntries:
        """Known entries as (q, pid, value), sorted."""
        return [(q, pid, value) for (q, pid), value in sorted(self._values.items())]

    def load(self, entries: Iterable[tuple[int, str, float]]) -> None:
        """Replace all entries."""
        self._values = {(q, pid): value for q, pid, value in entries}
