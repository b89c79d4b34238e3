"""The options that N evaluation episodes follow."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.environments.batched import Observations
from t4nmtd_dist.method.active_roles import NOBODY, ActiveRoles
from t4nmtd_dist.method.protocol import Method

Rows = NDArray[np.int64]


class HeldRoles:
    """Options of N episodes, chosen greedily, and held until the method ends them.

    Attributes:
        count: N.
    """

    def __init__(self, method: Method, count: int) -> None:
        self.count = count
        self._roles, self._names = ActiveRoles(method, count), method.roles
        self._q: NDArray[np.int32] | None = None

    def groups(self, observations: Observations, q: NDArray[np.int32]) -> Iterator[tuple[str, Rows]]:
        """The options and their rows in these observations [N, d] and DFA states [N]; call once per step."""
        over = np.ones(self.count, np.bool_) if self._q is None else self._roles.advance(self._q, q)
        self._q = q.copy()
        rows = np.flatnonzero(over)
        if len(rows):
            self._roles.choose(rows, q[rows], observations[rows])
        return self._roles.groups()

    @property
    def first(self) -> str | None:
        """The option of the first episode."""
        number = self._roles.numbers[0]
        return None if number == NOBODY else self._names[number]
