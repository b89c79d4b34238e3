"""Rollout of one role in N environments (paper, Algorithm 2, without learning)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.attempt_statistics import AttemptStatistics
from t4nmtd_dist.agents.common.restarts import Restarts
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.core.state_dict import State, stacked
from t4nmtd_dist.environments.batched import BatchedEnv, Observations, Rows
from t4nmtd_dist.method.protocol import NO_TARGET, Change, Ending, Mask, States
from t4nmtd_dist.method.rewards import SymbolReader
from t4nmtd_dist.method.roles import Role
from t4nmtd_dist.method.start_states import InitialStateBuffer, StartState


@dataclass(frozen=True)
class RolloutStep:
    """One step of all N environments, as transitions <s, q, a, reward, s', q'>.

    Attributes:
        reward: shaped reward, unscaled, float64 [N].
        next_observations: float32 [N, d], before any restart.
        q_next: int32 [N], before any restart.
        changed: the DFA state changed.
        terminal: F, E, or the environment terminated: the value of s' is 0.
        ended: the attempt ended; the environment has begun another.
        symbols: symbols read by the DFA, int64 [N].
        terminated: the environment terminated.
        reached: a target was reached.
    """

    reward: NDArray[np.float64]
    next_observations: Observations
    q_next: States
    changed: Mask
    terminal: Mask
    ended: Mask
    symbols: NDArray[np.int64]
    terminated: Mask
    reached: Mask


@dataclass
class Progress:
    """News for the coordinator: DFA changes, failed attempts, and start states, in order.

    Attributes:
        starts: (q', snapshot) of states handed over.
    """

    changes: list[Change] = field(default_factory=list)
    starts: list[tuple[int, NDArray[Any]]] = field(default_factory=list)


class AttemptRules(Protocol):
    """The rules of ``Method`` that a rollout needs."""

    def role(self, name: str) -> Role:
        """See ``Method.role``."""

    def starts(
        self, role: str, buffer: InitialStateBuffer, count: int, rng: np.random.Generator
    ) -> Sequence[StartState]:
        """See ``Method.starts``."""

    def ends(self, role: str, q: States, q_next: States, steps: States) -> NDArray[np.int8]:
        """See ``Method.ends``."""

    def hands_over(self, role: str, q: States, q_next: States) -> Mask:
        """See ``Method.hands_over``."""


class Rollout:
    """N environments, each always within an attempt of one role.

    On ``Ending.CHOOSE``, the attempt ends and the environment restarts.

    Args:
        env: the environments; ``interactions`` counts all their steps, replayed ones included.
        reader: maps labels to DFA symbols.
        method: decides where attempts start and end, and which states are handed over.
        role: name of the acting role.
        buffer: its start states.
        rng: random generator.

    Attributes:
        observations: current, float32 [N, d].
        q: current DFA states, int32 [N].
        statistics: of attempts.
        interactions: environment steps.
    """

    def __init__(
        self,
        env: BatchedEnv,
        reader: SymbolReader,
        method: AttemptRules,
        role: str,
        buffer: InitialStateBuffer,
        rng: np.random.Generator,
    ) -> None:
        self._env, self._reader, self._method, self._rng = env, reader, method, rng
        self._role = method.role(role)
        self._restarts = Restarts(env, buffer, lambda count: method.starts(role, buffer, count, rng), rng.spawn(1)[0])
        self.observations: Observations = np.zeros((env.count, env.observation_size), dtype=np.float32)
        self.q: States = np.zeros(env.count, dtype=np.int32)
        self._steps = np.zeros(env.count, dtype=np.int32)
        self._steps_in_q = np.zeros(env.count, dtype=np.int32)
        self._begun = False
        self._told = np.ones(env.count, dtype=np.bool_)  # copies whose attempts count
        self.progress = Progress()
        self.interactions = 0
        self.statistics = AttemptStatistics()

    def report_to(self, tell: Callable[[str], None]) -> None:
        """Pass ``tell`` a message about the first start state that cannot be restored."""
        self._restarts.tell = tell

    def take_progress(self) -> Progress:
        """The progress since the last call."""
        taken, self.progress = self.progress, Progress()
        return taken

    def begin(self) -> bool:
        """Begin every environment's first attempt, once; False while there is no start state."""
        if not self._begun:
            self._begun = self._start(np.arange(self._env.count))
        return self._begun

    def begin_anew(self) -> bool:
        """Start another attempt in every copy that is within one, of which nothing is told; False without a start."""
        if not self._begun:
            return self.begin()
        rows = np.flatnonzero(self._steps)
        return not len(rows) or self._start(rows)

    def attempt_once(self, act: Callable[[], NDArray[Any]]) -> bool:
        """One whole attempt of every copy from a new start; False while there is no start state.

        A copy that is done before others goes on, but of what it does then nothing is told. The first attempts to end
        are the short ones: to count those alone would tell a wrong share of successes.

        Args:
            act: actions for ``observations`` and ``q`` as they are [N].

        Raises:
            EnvError: see ``step``.
        """
        if not self.begin_anew():
            return False
        self._told[:] = True
        while self._told.any():
            self._told &= ~self.step(act()).ended
        self._told[:] = True
        return self.begin_anew()

    def step(self, actions: NDArray[Any]) -> RolloutStep:
        """Act in every environment, advance the DFA, and restart ended attempts.

        Raises:
            EnvError: if no attempt can begin.
        """
        step = self._transition(actions)
        self._report_changes(step)
        self._count_endings(step)
        self._hand_over(step)
        self.observations[:] = step.next_observations
        self.q = step.q_next.copy()  # a copy: restarts overwrite it
        self._steps_in_q[step.changed] = 0
        if step.ended.any() and not self._start(np.flatnonzero(step.ended)):
            raise EnvError("no attempt can begin any more: no start state that there was could be restored")
        return step

    def _transition(self, actions: NDArray[Any]) -> RolloutStep:
        """Step the environments and the DFA."""
        tables, q = self._role.tables, self.q
        env_step = self._env.step(actions)
        self.interactions += self._env.count
        self._steps += 1
        self._steps_in_q += 1
        symbols = self._reader.symbols(env_step.labels)
        q_next = self._reader.delta[q, symbols]
        terminal = tables.terminals(q_next, env_step.terminated)
        ending = self._method.ends(self._role.name, q, q_next, self._steps)
        return RolloutStep(
            reward=tables.transition_rewards(q, q_next, env_step.terminated),  # Algorithm 2, lines 7 to 9
            next_observations=env_step.observations.copy(),
            q_next=q_next,
            changed=q_next != q,
            terminal=terminal,
            ended=(ending != Ending.KEEP) | terminal | env_step.truncated,
            symbols=symbols,
            terminated=env_step.terminated,
            reached=tables.target[q, q_next],
        )

    def _report_changes(self, step: RolloutStep) -> None:
        """Report DFA changes and ends of attempts, for the update of Q."""
        for row in np.flatnonzero((step.changed | step.ended) & self._told):
            lost = step.terminal[row] and not self._role.tables.terminal[step.q_next[row]]  # a dead end is no progress
            counts = bool(step.changed[row] and not lost)
            q_next, reward = (int(step.q_next[row]), float(step.reward[row])) if counts else (NO_TARGET, 0.0)
            self.progress.changes.append(Change(int(self.q[row]), q_next, int(self._steps_in_q[row]), reward))

    def _count_endings(self, step: RolloutStep) -> None:
        ended = step.ended & self._told
        for row in np.flatnonzero(ended):
            self.statistics.add(bool(step.reached[row]), int(self._steps[row]))
        failed = ended & ~step.reached
        if failed.any():
            errors = failed & self._role.tables.error[step.q_next]
            stranded = self._role.stranded(self.q, step.q_next)
            endings = self.statistics.endings
            endings.errors += int(errors.sum())
            endings.terminated += int((failed & step.terminated & ~errors).sum())
            endings.timeouts += int((failed & ~step.terminal & ~stranded).sum())

    def _hand_over(self, step: RolloutStep) -> None:
        """Snapshot the states handed over."""
        wanted = self._method.hands_over(self._role.name, self.q, step.q_next)
        handed = np.flatnonzero(wanted & ~step.terminal & self._told)
        if len(handed):
            states = self._env.snapshot(handed)
            self.progress.starts += [(int(step.q_next[row]), s) for row, s in zip(handed, states, strict=True)]

    def _start(self, rows: Rows) -> bool:
        """Begin attempts; False if there is no start."""
        before = self._env.replayed
        try:
            starts = self._restarts.begin(rows, self.observations)
        finally:
            self.interactions += self._env.replayed - before
        if starts:
            self.q[rows] = [start.q for start in starts]
            self._steps[rows] = 0
            self._steps_in_q[rows] = 0
        return bool(starts)

    def state_dict(self) -> State:
        """State and counts of the rollout, for a checkpoint."""
        progress = self.progress
        return {
            "columns": {name: column.copy() for name, column in self._columns().items()},
            "begun": self._begun,
            "env": self._env.state_dict() if self._begun else None,
            "rng": self._rng.bit_generator.state,
            "seeds": self._restarts.rng.bit_generator.state,
            "counts": [self.interactions, *self.statistics.counts],
            "recent": self.statistics.recent,
            "changes": list(progress.changes),
            "starts": {"q": [q for q, _ in progress.starts], "states": stacked([s for _, s in progress.starts])},
        }

    def load_state_dict(self, state: State) -> None:
        """Restore from the ``state_dict`` of a rollout with the same role and size."""
        for name, column in self._columns().items():
            column[:] = state["columns"][name]
        self._begun = state["begun"]
        if self._begun:
            self._env.load_state_dict(state["env"])
        self._rng.bit_generator.state = state["rng"]
        self._restarts.rng.bit_generator.state = state["seeds"]
        self.interactions, *counts = state["counts"]
        self.statistics.load(counts, state["recent"])
        starts = list(zip(state["starts"]["q"], state["starts"]["states"], strict=True))
        self.progress = Progress([Change(*change) for change in state["changes"]], starts)

    def _columns(self) -> dict[str, NDArray[Any]]:
        return {
            "observations": self.observations,
            "q": self.q,
            "steps": self._steps,
            "steps_in_q": self._steps_in_q,
            "seeded": self._restarts.seeded,
        }
