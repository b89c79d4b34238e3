"""Attempts at one sub-task in N copies of the environment (paper, Algorithm 2, lines 1 to 10, without learning)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.core.state_dict import State, stacked
from t4nmtd_dist.environments.batched import BatchedEnv, Observations, Rows
from t4nmtd_dist.method.rewards import SubtaskTables, SymbolReader
from t4nmtd_dist.method.start_states import InitialStateBuffer, StartState, sample_starts

NO_TARGET = -1
RECENT_ATTEMPTS = 100
MOST_FAILURES = 50

Mask = NDArray[np.bool_]
States = NDArray[np.int32]


@dataclass(frozen=True)
class AttemptStep:
    """One step of all N copies, as experience <s, q, a, reward, s', q'>.

    Attributes:
        reward: shaped reward, unscaled, float64 [N].
        next_observations: float32 [N, d], before any restart.
        q_next: int32 [N], before any restart.
        changed: the DFA moved to another state.
        terminal: F, E or an environment that ended: the critic's value of s' is 0.
        ended: the attempt is over; the copy has begun another.
        symbols: what the DFA read, int64 [N].
        terminated: the environment ended.
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
    """What the coordinator must hear of: DFA changes, failed attempts, and start states for others.

    Attributes:
        changes: (q, q' or NO_TARGET, steps since q was entered, shaped reward), in order.
        starts: (q', snapshot) of reached targets.
    """

    changes: list[tuple[int, int, int, float]] = field(default_factory=list)
    starts: list[tuple[int, NDArray[Any]]] = field(default_factory=list)


@dataclass
class Endings:
    """How attempts without success have ended: in an error state, with the environment, or by lack of time."""

    errors: int = 0
    terminated: int = 0
    timeouts: int = 0


class Attempts:
    """N copies of the environment, each always within an attempt at the sub-task.

    Args:
        env: the copies; every one of their steps is counted in ``interactions``, replayed ones too.
        reader: symbols of the DFA from the environment's labels.
        tables: the sub-task.
        delta: the DFA's transition table, int32 [Q, symbols].
        buffer: where attempts begin.
        reset_q: the initial DFA state if the sub-task is available there, else None.
        attempt_steps: steps after which an attempt is cut.
        hand_over_all: hand states over after every change of the DFA state, not only after targets.
        rng: source of randomness.

    Attributes:
        pulse: called before every step, and by learners between the parts of a long update: a sign of life.
        tell: called with a line about the first start state that cannot be restored.
    """

    def __init__(
        self,
        env: BatchedEnv,
        reader: SymbolReader,
        tables: SubtaskTables,
        delta: NDArray[np.int32],
        buffer: InitialStateBuffer,
        *,
        reset_q: int | None,
        attempt_steps: int,
        hand_over_all: bool,
        rng: np.random.Generator,
    ) -> None:
        self._env, self._reader, self._tables, self._delta = env, reader, tables, delta
        self._buffer, self._reset_q, self._attempt_steps, self._rng = buffer, reset_q, attempt_steps, rng
        self.observations: Observations = np.zeros((env.count, env.observation_size), dtype=np.float32)
        self.q: States = np.zeros(env.count, dtype=np.int32)
        self._steps = np.zeros(env.count, dtype=np.int32)
        self._steps_in_q = np.zeros(env.count, dtype=np.int32)
        self._hand_over_all = hand_over_all
        self._seeds = rng.spawn(1)[0]
        self._seeded = np.zeros(env.count, dtype=np.bool_)
        self._begun = False
        self.pulse: Callable[[], None] = lambda: None
        self.tell: Callable[[str], None] = print
        self._told = False
        self._failures = 0  # to restore a start state, in a row
        self._restored: StartState | None = None
        self.progress = Progress()
        self.interactions = 0
        self.attempts = 0
        self.successes = 0
        self.endings = Endings()
        self._recent: deque[tuple[bool, int]] = deque(maxlen=RECENT_ATTEMPTS)

    @property
    def recent_success(self) -> float | None:
        """Share of the last attempts that reached a target; None before the first ended."""
        return float(np.mean([success for success, _ in self._recent])) if self._recent else None

    @property
    def recent_length(self) -> float | None:
        """Mean length of the last attempts in steps."""
        return float(np.mean([steps for _, steps in self._recent])) if self._recent else None

    def state_dict(self) -> State:
        """Everything that decides how the attempts go on, and all counts, for a checkpoint."""
        progress = self.progress
        return {
            "columns": {name: column.copy() for name, column in self._columns().items()},
            "begun": self._begun,
            "env": self._env.state_dict() if self._begun else None,
            "rng": self._rng.bit_generator.state,
            "seeds": self._seeds.bit_generator.state,
            "counts": [self.interactions, self.attempts, self.successes, *vars(self.endings).values()],
            "recent": list(self._recent),
            "changes": list(progress.changes),
            "starts": {"q": [q for q, _ in progress.starts], "states": stacked([s for _, s in progress.starts])},
        }

    def load_state_dict(self, state: State) -> None:
        """Go on from a ``state`` of attempts at the same sub-task in as many copies."""
        for name, column in self._columns().items():
            column[:] = state["columns"][name]
        self._begun = state["begun"]
        if self._begun:
            self._env.load_state_dict(state["env"])
        self._rng.bit_generator.state, self._seeds.bit_generator.state = state["rng"], state["seeds"]
        self.interactions, self.attempts, self.successes, *endings = state["counts"]
        self.endings = Endings(*endings)  # those of an earlier version are not known
        self._recent.clear()
        self._recent.extend((success, steps) for success, steps in state["recent"])
        starts = list(zip(state["starts"]["q"], state["starts"]["states"], strict=True))
        self.progress = Progress([(q, to, steps, reward) for q, to, steps, reward in state["changes"]], starts)

    def _columns(self) -> dict[str, NDArray[Any]]:
        return {
            "observations": self.observations,
            "q": self.q,
            "steps": self._steps,
            "steps_in_q": self._steps_in_q,
            "seeded": self._seeded,
        }

    def take_progress(self) -> Progress:
        """What happened since the last call."""
        taken, self.progress = self.progress, Progress()
        return taken

    def begin(self) -> bool:
        """Start the first attempt of every copy, if that has not been done; False while there is no start state."""
        if not self._begun:
            self._begun = self._start(np.arange(self._env.count))
        return self._begun

    def _start(self, rows: Rows) -> bool:
        """Begin an attempt in each of these copies; False if there is nowhere to begin."""
        starts = list(sample_starts(self._buffer, self._reset_q, len(rows), self._rng))
        if not starts:
            return False
        fresh = np.array([start.state is None for start in starts])
        self._reset(rows[fresh])
        if not self._restore(rows, starts, np.flatnonzero(~fresh)):
            return False
        self.q[rows] = [start.q for start in starts]
        self._steps[rows] = 0
        self._steps_in_q[rows] = 0
        return True

    def _reset(self, rows: Rows) -> None:
        """The environment's own reset; a copy's first one seeds its random generator."""
        for part, seeds in ((rows[~self._seeded[rows]], True), (rows[self._seeded[rows]], False)):
            if len(part):
                seed = int(self._seeds.integers(2**31)) if seeds else None
                self.observations[part] = self._env.reset(part, seed)
                self._seeded[part] = True

    def _restore(self, rows: Rows, starts: list[StartState], places: Rows) -> bool:
        """Restore the copies ``rows[places]`` from their starts; one that cannot be is replaced in ``starts``.

        Returns:
            False if none is left to replace it.

        Raises:
            EnvError: if one after another cannot be restored: it is the environment that fails.
        """
        if not len(places):
            return True
        before = self._env.replayed
        try:
            self._restore_all(rows[places], [starts[place] for place in places])
            return True
        except Exception:  # whatever an environment makes of a state from elsewhere
            return all(self._restore_one(rows, starts, place) for place in places)
        finally:
            self.interactions += self._env.replayed - before

    def _restore_all(self, rows: Rows, starts: list[StartState]) -> None:
        observations = self._env.restore(rows, [start.state for start in starts if start.state is not None])
        if not np.isfinite(observations).all():
            raise EnvError("its observation holds NaN or infinity")
        self.observations[rows] = observations
        self._failures, self._restored = 0, starts[-1]

    def _restore_one(self, rows: Rows, starts: list[StartState], place: int) -> bool:
        row = rows[place : place + 1]
        while starts[place].state is not None:
            try:
                self._restore_all(row, [starts[place]])
                return True
            except Exception as error:
                self._drop(starts[place], error)
            another = next(iter(sample_starts(self._buffer, self._reset_q, 1, self._rng)), self._restored)
            if another is None:
                return False
            starts[place] = another
        self._reset(row)
        return True

    def _drop(self, start: StartState, error: Exception) -> None:
        """Do without a start state; the first is told of."""
        self._failures += 1
        if self._failures >= MOST_FAILURES:
            raise EnvError(
                f"{self._failures} start states in a row could not be restored, the last for {type(error).__name__}: "
                f"{error}; mend how the environment restores states (t4nmtd check), or choose another way (snapshots)"
            ) from error
        if start.state is not None:
            self._buffer.remove(start.q, start.state)
        if not self._told:
            self._told = True
            self.tell(f"a start state of DFA state {start.q} is dropped, for it cannot be restored: {error}")

    def step(self, actions: NDArray[Any]) -> AttemptStep:
        """Act in every copy, move the DFA, and begin again where an attempt is over."""
        self.pulse()
        tables, q = self._tables, self.q
        env_step = self._env.step(actions)
        self.interactions += self._env.count
        self._steps += 1
        self._steps_in_q += 1
        symbols = self._reader.symbols(env_step.labels)
        q_next = self._delta[q, symbols]
        changed = q_next != q
        reached = tables.target[q, q_next]
        terminal = tables.terminal[q_next] | env_step.terminated
        stranded = changed & ~tables.available[q_next]
        timed_out = env_step.truncated | (self._steps >= self._attempt_steps)
        ended = reached | terminal | stranded | timed_out
        reward = tables.reward[q, q_next] - np.where(env_step.terminated, tables.carried_potential[q_next], 0.0)
        result = AttemptStep(
            reward=reward,
            next_observations=env_step.observations.copy(),
            q_next=q_next,
            changed=changed,
            terminal=terminal,
            ended=ended,
            symbols=symbols,
            terminated=env_step.terminated,
            reached=reached,
        )
        self._note(result)
        self.observations[:] = env_step.observations
        self.q = q_next.copy()  # restarts write into it; the experience keeps its own
        self._steps_in_q[changed] = 0
        if ended.any() and not self._start(np.flatnonzero(ended)):
            raise EnvError("no attempt can begin any more: no start state that there was could be restored")
        return result

    def _note(self, step: AttemptStep) -> None:
        told = step.changed | step.ended
        if not told.any():
            return
        counts = step.changed & ~(step.terminal & ~self._tables.terminal[step.q_next])  # no way on: no progress
        for row in np.flatnonzero(told):
            q_next = int(step.q_next[row]) if counts[row] else NO_TARGET
            reward = float(step.reward[row]) if counts[row] else 0.0
            self.progress.changes.append((int(self.q[row]), q_next, int(self._steps_in_q[row]), reward))
        for row in np.flatnonzero(step.ended):
            self._recent.append((bool(step.reached[row]), int(self._steps[row])))
        self.attempts += int(step.ended.sum())
        self.successes += int(step.reached.sum())
        self._count_endings(step)
        handed = np.flatnonzero((step.changed if self._hand_over_all else step.reached) & ~step.terminal)
        if len(handed):
            states = self._env.snapshot(handed)
            self.progress.starts += [(int(step.q_next[r]), s) for r, s in zip(handed, states, strict=True)]

    def _count_endings(self, step: AttemptStep) -> None:
        failed = step.ended & ~step.reached
        if failed.any():
            errors = failed & self._tables.error[step.q_next]
            terminated = failed & step.terminated & ~errors
            stranded = step.changed & ~self._tables.available[step.q_next]
            self.endings.errors += int(errors.sum())
            self.endings.terminated += int(terminated.sum())
            self.endings.timeouts += int((failed & ~step.terminal & ~stranded).sum())
