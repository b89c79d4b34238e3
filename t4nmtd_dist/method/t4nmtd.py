"""T4NMTD: one sub-task per literal, joined by a Q table (paper, Algorithm 1 and the choices of Algorithm 2)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.deadline import Deadline
from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.automata.formula import names_in_order
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.decomposition import decompose as decompose_automaton
from t4nmtd_dist.method.high_level import QEntries, QTable
from t4nmtd_dist.method.protocol import NO_TARGET, Change, Ending, Mask, Reading, States, Unstaged
from t4nmtd_dist.method.roles import Role, role_of
from t4nmtd_dist.method.start_states import InitialStateBuffer, StartState, sample_starts


def decompose(config: TaskConfig, dfa: DFA, *, seed: int, deadline: Deadline | None) -> Decomposition:
    """The sub-tasks under the task's settings; see ``method.decomposition.decompose``."""
    settings = config.decomposition
    return decompose_automaton(
        dfa,
        exclusive=config.exclusive,
        mode=settings.mode,
        prune=settings.prune,
        error_transitions=settings.error_transitions,
        keep=settings.keep,
        order=names_in_order(config.formula),
        seed=seed,
        deadline=deadline,
    )


def build(config: TaskConfig, dfa: DFA, decomposition: Decomposition, rho: NDArray[np.float64]) -> T4NMTD:
    """See ``MethodModule.build``."""
    return T4NMTD(config, dfa, decomposition, rho)


class T4NMTD(Unstaged):
    """The rules of ``Method`` with sub-tasks as roles.

    Attributes:
        q_table: Q(q, T).
        shares_env: every sub-task acts in an environment of its own.
    """

    shares_env = False

    def __init__(self, config: TaskConfig, dfa: DFA, decomposition: Decomposition, rho: NDArray[np.float64]) -> None:
        self._config, self._dfa, self._decomposition, self._rho = config, dfa, decomposition, rho
        self._roles: dict[str, Role] = {}
        self.q_table = QTable(
            decomposition,
            dfa.accepting | dfa.error,
            alpha=config.high_level.alpha,
            gamma=config.learner.gamma,
            epsilon=config.high_level.epsilon,
            smdp_discount=config.high_level.smdp_discount,
        )

    @property
    def roles(self) -> tuple[str, ...]:
        """The sub-tasks."""
        return self._decomposition.pids

    def role(self, name: str) -> Role:
        """The sub-task; see ``Method.role``."""
        if name not in self._roles:
            self._roles[name] = role_of(self._config, self._dfa, self._decomposition, self._rho, name)
        return self._roles[name]

    def starts(
        self, role: str, buffer: InitialStateBuffer, count: int, rng: np.random.Generator
    ) -> Sequence[StartState]:
        """From B_iota (Algorithm 2, line 1); ``learner.start_states`` says how."""
        by_entry = self._config.learner.start_states == "entries"
        return sample_starts(buffer, self.role(role).reset_q, count, rng, by_entry=by_entry)

    def ends(self, role: str, q: States, q_next: States, steps: States) -> NDArray[np.int8]:
        """An attempt ends at a target, where the sub-task has no transition, and after ``attempt_steps``."""
        own = self.role(role)
        over = own.tables.target[q, q_next] | (steps >= own.attempt_steps)
        if self._config.learner.stranded_ends:
            over |= own.stranded(q, q_next)
        return np.where(over, Ending.RESTART, Ending.KEEP).astype(np.int8)

    def hands_over(self, role: str, q: States, q_next: States) -> Mask:
        """Hands over targets, as in the paper, or all DFA changes: ``learner.hand_over``."""
        if self._config.learner.hand_over == "changes":
            return np.not_equal(q, q_next)
        reached: Mask = self.role(role).tables.target[q, q_next]
        return reached

    def receivers(self, role: str, q: int, rng: np.random.Generator) -> Collection[str]:
        """T_iota' ~ E(Q, q) stores the state."""
        chosen = self.q_table.choose(q, rng)
        return () if chosen is None else (chosen,)

    def reads(self, role: str) -> Reading:
        """Own and peers' rows, in every DFA state with a transition of the sub-task (docs/decisions/016)."""
        return Reading(np.flatnonzero(self.role(role).tables.available).astype(np.int32), "all")

    def successors(self, role: str, q_next: States, rng: np.random.Generator) -> list[str | None]:
        """Policy intervention: the peer T_iota' ~ E(Q, q'); the own critic if no sub-task is available."""
        return [self.q_table.choose(q, rng) or role for q in q_next.tolist()]

    def choose(
        self,
        q: Sequence[int],
        rng: np.random.Generator | None = None,
        *,
        observations: NDArray[np.float32] | None = None,
        among: Collection[str] | None = None,
    ) -> list[str | None]:
        """E(Q, q), or arg max Q(q, .) without ``rng``; ignores observations."""
        if rng is None:
            return [self.q_table.greedy(each, among) for each in q]
        return [self.q_table.choose(each, rng, among) for each in q]

    def told(self, role: str, changes: Iterable[Change]) -> None:
        """Update Q(q, T) for every change, towards 0 for a failed attempt (Algorithm 1)."""
        for q, q_next, steps, reward in changes:
            if q_next == NO_TARGET:
                if self._config.high_level.learn_failures:
                    self.q_table.fail(q, role)
            else:
                self.q_table.update(q, role, reward, q_next, steps)

    def schedule(self) -> None:
        """All sub-tasks learn in parallel."""

    def entries(self) -> QEntries:
        """Every known Q(q, T)."""
        return self.q_table.entries()

    def load(self, entries: Iterable[tuple[int, str, float]]) -> None:
        """Replace all of Q."""
        self.q_table.load(entries)
