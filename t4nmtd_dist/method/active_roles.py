"""The role that each of N environment copies follows, where roles share an environment."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.method.protocol import Ending, Mask, Method, States

Rows = NDArray[np.int64]
NOBODY = -1


class ActiveRoles:
    """Roles held by N copies until the method says ``CHOOSE`` or ``RESTART``.

    Intended loop::

        roles.choose(all rows, q, observations)
        while True:
            for role, rows in roles.groups():
                ...                                             # act
            over = roles.advance(q, q_next)
            roles.choose(rows over or reset, ...)

    Args:
        method: decides.
        count: N.
        among: roles to choose from; None for all.

    Attributes:
        numbers: index of each copy's role in ``method.roles``, or ``NOBODY``, int32 [N].
    """

    def __init__(self, method: Method, count: int, among: Collection[str] | None = None) -> None:
        self._method, self._names, self._among = method, method.roles, among
        self._index = {name: number for number, name in enumerate(self._names)}
        self.numbers: States = np.full(count, NOBODY, np.int32)
        self._steps: States = np.zeros(count, np.int32)

    def choose(
        self, rows: Rows, q: States, observations: NDArray[np.float32], rng: np.random.Generator | None = None
    ) -> None:
        """Choose roles for ``rows`` [k], which are in ``q`` [k] and ``observations`` [k, d]; greedily without ``rng``.

        A copy without an available role has none afterwards.
        """
        chosen = self._method.choose(q.tolist(), rng, observations=observations, among=self._among)
        self.numbers[rows] = [NOBODY if name is None else self._index[name] for name in chosen]
        self._steps[rows] = 0

    def groups(self) -> Iterator[tuple[str, Rows]]:
        """Each active role and its copies."""
        for number in np.unique(self.numbers[self.numbers >= 0]):
            yield self._names[number], np.flatnonzero(self.numbers == number)

    def advance(self, q: States, q_next: States) -> Mask:
        """Count a step from ``q`` to ``q_next`` [N]; returns the copies whose role ends, bool [N]."""
        self._steps += 1
        over: Mask = self.numbers == NOBODY
        for role, rows in self.groups():
            over[rows] = self._method.ends(role, q[rows], q_next[rows], self._steps[rows]) != Ending.KEEP
        return over

    def state_dict(self) -> State:
        """Roles and steps, for a checkpoint."""
        return {"numbers": self.numbers.copy(), "steps": self._steps.copy()}

    def load_state_dict(self, state: State) -> None:
        """Restore from ``state_dict``."""
        self.numbers[:], self._steps[:] = state["numbers"], state["steps"]
