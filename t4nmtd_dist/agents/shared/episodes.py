"""Whole episodes for ``Rollout``, where roles share an environment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.protocol import Ending, Mask, Method, States
from t4nmtd_dist.method.roles import Role, role_of
from t4nmtd_dist.method.start_states import InitialStateBuffer, StartState


class Episodes:
    """``AttemptRules`` of attempts at the whole task: from the reset until acceptance, an error or the horizon.

    An episode also ends where no role of the method is available.
    """

    def __init__(self, task: CompiledTask, method: Method) -> None:
        self._task = task
        self._nobody = np.array([name is None for name in method.choose(range(task.dfa.states))])

    def role(self, name: str) -> Role:
        """Its targets are the transitions into F."""
        accepting = self._task.dfa.accepting
        transitions = self._task.decomposition.transitions
        whole = Decomposition({name: tuple(tau for tau in transitions if tau[1] in accepting)})
        return role_of(self._task.config, self._task.dfa, whole, self._task.rho, name)

    def starts(
        self, role: str, buffer: InitialStateBuffer, count: int, rng: np.random.Generator
    ) -> Sequence[StartState]:
        """The environment's reset."""
        return [StartState(self._task.dfa.initial, None)] * count

    def ends(self, role: str, q: States, q_next: States, steps: States) -> NDArray[np.int8]:
        """At the horizon, and where no role is available."""
        over = self._nobody[q_next] | (steps >= self._task.config.environment.horizon)
        return np.where(over, Ending.RESTART, Ending.KEEP).astype(np.int8)

    def hands_over(self, role: str, q: States, q_next: States) -> Mask:
        """Nothing is handed over."""
        return np.zeros(len(q), np.bool_)
