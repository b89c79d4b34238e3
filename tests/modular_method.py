"""A third method, of the tests alone: one module per DFA state, which acts until the DFA moves (after Mod).

With ``STORED`` its modules start in the states that others reached, else at the environment's reset only.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.deadline import Deadline
from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.core.setting_types import CountOrZero
from t4nmtd_dist.method import t4nmtd
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.protocol import Change, Ending, Mask, Reading, States, Unstaged
from t4nmtd_dist.method.roles import Role, role_of
from t4nmtd_dist.method.start_states import InitialStateBuffer, StartState, sample_starts

STORED = False
PASSIVE: frozenset[str] = frozenset()
"""Modules that are not scheduled."""


def decompose(config: TaskConfig, dfa: DFA, *, seed: int, deadline: Deadline | None) -> Decomposition:
    """The transitions that T4NMTD's sub-tasks have, by their source."""
    transitions = t4nmtd.decompose(config, dfa, seed=seed, deadline=deadline).transitions
    return Decomposition({f"q{q}": [tau for tau in transitions if tau[0] == q] for q, _ in transitions})


@dataclass(frozen=True)
class ModularConfig:
    """The section ``[modular]``."""

    spare_modules: CountOrZero = 0


CONFIG = ModularConfig


class Modular(Unstaged):
    shares_env = False

    def __init__(self, config: TaskConfig, dfa: DFA, decomposition: Decomposition, rho: NDArray[np.float64]) -> None:
        self._roles = {pid: role_of(config, dfa, decomposition, rho, pid) for pid in decomposition.pids}
        self.reported: list[tuple[str, Change]] = []

    @property
    def roles(self) -> tuple[str, ...]:
        return tuple(self._roles)

    def role(self, name: str) -> Role:
        return self._roles[name]

    def starts(
        self, role: str, buffer: InitialStateBuffer, count: int, rng: np.random.Generator
    ) -> Sequence[StartState]:
        return sample_starts(buffer, self.role(role).reset_q, count, rng)

    def ends(self, role: str, q: States, q_next: States, steps: States) -> NDArray[np.int8]:
        restart = np.where(steps >= self.role(role).attempt_steps, Ending.RESTART, Ending.KEEP)
        return np.where(q != q_next, Ending.CHOOSE, restart).astype(np.int8)

    def hands_over(self, role: str, q: States, q_next: States) -> Mask:
        return (q != q_next) & STORED

    def receivers(self, role: str, q: int, rng: np.random.Generator) -> Collection[str]:
        return self._modules([q])

    def reads(self, role: str) -> Reading:
        return Reading(np.flatnonzero(self.role(role).tables.available).astype(np.int32), "own")

    def successors(self, role: str, q_next: States, rng: np.random.Generator) -> list[str | None]:
        return self.choose(q_next.tolist())

    def choose(
        self,
        q: Sequence[int],
        rng: np.random.Generator | None = None,
        *,
        observations: NDArray[np.float32] | None = None,
        among: Collection[str] | None = None,
    ) -> list[str | None]:
        able = self._roles if among is None else among
        return [f"q{each}" if f"q{each}" in able else None for each in q]

    def _modules(self, q: Sequence[int]) -> list[str]:
        return [name for name in self.choose(q) if name is not None]

    def told(self, role: str, changes: Iterable[Change]) -> None:
        self.reported += [(role, change) for change in changes]

    def schedule(self) -> Collection[str] | None:
        return self._roles.keys() - PASSIVE if PASSIVE else None

    def entries(self) -> list[tuple[int, str, float]]:
        return []

    def load(self, entries: Iterable[tuple[int, str, float]]) -> None:
        assert not list(entries)


def build(config: Any, dfa: DFA, decomposition: Decomposition, rho: NDArray[np.float64]) -> Modular:
    return Modular(config, dfa, decomposition, rho)
