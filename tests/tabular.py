"""Q-learning in tables, driven by a method's rules alone: who acts, which rows are read where, whose value follows.

One table stands for each network; a role of a network with goals has one for its goal. Rules are asked once for every
case and remembered, so that a step takes microseconds.
"""

from __future__ import annotations

import random
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from grid_worlds import World
from numpy.typing import NDArray

from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.method.options import ClosedOptions, LinearSchedule, OpenOptions, OptionMethod
from t4nmtd_dist.method.protocol import Ending, Method
from t4nmtd_dist.method.rewards import environment_rewards

Row = list[float]
Table = list[Row]  # of one role in one DFA state: a row for each cell

ALWAYS = LinearSchedule(0.1, 0.1)


class Lesson(NamedTuple):
    """What one step teaches a role in one DFA state: reward, and whose value in which state follows (None: 0)."""

    role: str
    q: int
    reward: float
    heir: str | None
    q_next: int


class Episode(NamedTuple):
    end: int
    length: int
    reward: float


@dataclass
class UpperTable:
    """Values of options by cell and DFA state; observations are numbers of cells."""

    options: int
    rate: float = 0.5
    initial: float = 2.0
    scale: float = 0.01

    def __post_init__(self) -> None:
        self.table: dict[tuple[int, int], NDArray[np.float64]] = {}

    def row(self, cell: float, q: int) -> NDArray[np.float64]:
        return self.table.setdefault((int(cell), int(q)), np.full(self.options, self.initial))

    def values(self, observations: NDArray[np.float32], q: NDArray[np.int32]) -> NDArray[np.float64]:
        return np.stack([self.row(cell, state) for (cell,), state in zip(observations, q, strict=True)])

    def learn(self, closed: ClosedOptions) -> None:
        for n, choice in enumerate(closed.choices):
            target = closed.rewards[n] * self.scale
            if closed.discounts[n]:
                follows = self.row(closed.next_observations[n, 0], closed.q_next[n])
                target += closed.discounts[n] * follows[closed.mask[n]].max()
            row = self.row(closed.observations[n, 0], closed.q[n])
            row[choice] += self.rate * (target - row[choice])


class Tabular:
    """One copy of a world and all roles of a method.

    Args:
        task: the task, for its automaton and settings.
        method: its rules.
        world: where it is learned.
        seed: of everything drawn.
        rate: step size.
        initial: every value at first.
        epsilon: share of random actions, by how often the role was chosen before.
        pays: what an episode's changes of the DFA state count for its reward, [Q, Q]; by default 1 for acceptance.
    """

    def __init__(
        self,
        task: CompiledTask,
        method: Method,
        world: World,
        *,
        seed: int,
        rate: float = 0.5,
        initial: float = 2.0,
        epsilon: LinearSchedule = ALWAYS,
        pays: NDArray[np.float64] | None = None,
    ) -> None:
        settings = task.config.learner
        self.task, self.method, self.world = task, method, world
        self.rate, self.initial, self.epsilon = rate, initial, epsilon
        self.gamma, self.scale = settings.gamma, settings.reward_scale
        self.delta: list[list[int]] = task.dfa.delta.tolist()
        self.terminal = {*task.dfa.accepting, *task.dfa.error}
        paid = environment_rewards(task.dfa) * self.scale if pays is None else pays
        self.pays: list[list[float]] = paid.tolist()
        self.random, self.rng = random.Random(seed), np.random.default_rng(seed)
        self.tables: dict[tuple[str, int | None, int], Table] = {}
        self.readings = {name: method.reads(name) for name in method.roles}
        self.episodes: list[Episode] = []
        self.steps = 0
        self._options = method if isinstance(method, OptionMethod) else None
        self._open: OpenOptions | None = self._options.open_options(1, 1) if self._options else None
        self._symbols = world.symbols(task)
        self._endings: dict[tuple[str, int, int], int] = {}
        self._limits: dict[tuple[str, int], int] = {}
        self._updates: dict[tuple[str, int, int], list[tuple[Table, float, Table | None]]] = {}
        self._times_chosen = dict.fromkeys(method.roles, 0)
        self._begin()

    # Rules, asked once

    def table(self, name: str, q: int) -> Table:
        """Values of a role in a DFA state."""
        role = self.method.role(name)
        key = role.network, role.goal, q
        if key not in self.tables:
            self.tables[key] = [[self.initial] * len(actions) for actions in self.world.moves]
        return self.tables[key]

    def lessons(self, active: str, q: int, symbol: int) -> list[Lesson]:
        """What a step of the active role in q teaches whom."""
        found = []
        for name, reading in self.readings.items():
            if reading.rows == "all":
                found += [self.lesson(name, u, symbol) for u in reading.q.tolist()]
            elif name == active:
                found.append(self.lesson(name, q, symbol))
        return found

    def lesson(self, name: str, q: int, symbol: int) -> Lesson:
        """What the step means for one role in one DFA state."""
        tables, q_next = self.method.role(name).tables, self.delta[q][symbol]
        before, after, no = np.array([q], np.int32), np.array([q_next], np.int32), np.zeros(1, np.bool_)
        reward = float(tables.transition_rewards(before, after, no)[0]) * self.scale
        heir: str | None = name
        if tables.terminals(after, no)[0]:
            heir = None
        elif q_next != q:
            (heir,) = self.method.successors(name, after, self.rng)
        return Lesson(name, q, reward, heir, q_next)

    def updated_table(self, lesson: Lesson) -> Table:
        """Where a lesson is stored."""
        return self.table(lesson.role, lesson.q)

    def following_table(self, lesson: Lesson) -> Table | None:
        """Where its bootstrap value comes from."""
        return None if lesson.heir is None else self.table(lesson.heir, lesson.q_next)

    def _updates_of(self, active: str, q: int, symbol: int) -> list[tuple[Table, float, Table | None]]:
        key = active, q, symbol
        if key not in self._updates:
            self._updates[key] = [
                (self.updated_table(each), each.reward, self.following_table(each))
                for each in self.lessons(active, q, symbol)
            ]
        return self._updates[key]

    def _ending(self, active: str, q: int, q_next: int, steps: int) -> int:
        key = active, q, q_next
        if key not in self._endings:
            self._endings[key] = self._ask(active, q, q_next, np.ones(1, np.int32))[0]
        if self._endings[key] != Ending.KEEP:
            return self._endings[key]
        if (active, q) not in self._limits:
            cut = self._ask(active, q, q, np.arange(self.task.config.environment.horizon + 1, dtype=np.int32))
            self._limits[active, q] = next((n for n, ending in enumerate(cut) if ending != Ending.KEEP), len(cut))
        return Ending.KEEP if steps < self._limits[active, q] else Ending.CHOOSE

    def _ask(self, active: str, q: int, q_next: int, steps: NDArray[np.int32]) -> list[int]:
        before, after = np.full(len(steps), q, np.int32), np.full(len(steps), q_next, np.int32)
        found: list[int] = self.method.ends(active, before, after, steps).tolist()
        return found

    # Learning

    def _begin(self) -> None:
        """A new episode."""
        self.cell, self.q = self.world.start, self.task.dfa.initial
        self.length, self.reward = 0, 0.0
        self._choose()

    def _choose(self) -> None:
        """Give the row to another role, and begin its option."""
        observations = np.array([[self.cell]], np.float32)
        (chosen,) = self.method.choose([self.q], self.rng, observations=observations)
        assert chosen is not None, "nobody acts here"
        self.active, self.held = chosen, 0
        self.share = self.epsilon.after(self._times_chosen[chosen])
        self._times_chosen[chosen] += 1
        if self._open:
            self._open.open(np.zeros(1, np.int64), observations, np.array([self.q], np.int32), [chosen])

    def _close(self) -> None:
        if self._open and self._options and self._options.upper:
            closed = self._open.close(
                np.zeros(1, np.int64),
                np.array([[self.cell]], np.float32),
                np.array([self.q], np.int32),
                np.array([self.q in self.terminal]),
            )
            self._options.upper.learn(closed)

    def _earn(self, q: int, q_next: int) -> None:
        assert self._open
        assert self._options
        no = np.zeros(1, np.bool_)
        paid = self._options.upper_rewards(self.active, np.array([q]), np.array([q_next]), no)
        self._open.earn(paid)

    def act(self, row: Row) -> int:
        """Epsilon-greedy, ties at random."""
        if self.random.random() < self.share:
            return int(self.random.random() * len(row))
        best = max(row)
        if row.count(best) == 1:
            return row.index(best)
        return self.random.choice([action for action, value in enumerate(row) if value == best])

    def run(self, until: int) -> Tabular:
        """Learn until so many steps have been made in all."""
        moves, symbols, delta, horizon = (
            self.world.moves,
            self._symbols,
            self.delta,
            self.task.config.environment.horizon,
        )
        rate, gamma = self.rate, self.gamma
        while self.steps < until:
            cell, q = self.cell, self.q
            action = self.act(self.table(self.active, q)[cell])
            to = moves[cell][action]
            symbol = symbols[to]
            q_next = delta[q][symbol]
            for table, reward, following in self._updates_of(self.active, q, symbol):
                row = table[cell]
                target = reward if following is None else reward + gamma * max(following[to])
                row[action] += rate * (target - row[action])
            self.reward += self.pays[q][q_next]
            if self._open:
                self._earn(q, q_next)
            self.cell, self.q = to, q_next
            self.steps, self.length, self.held = self.steps + 1, self.length + 1, self.held + 1
            if q_next in self.terminal or self.length >= horizon:
                self.episodes.append(Episode(self.steps, self.length, self.reward))
                self._close()
                self._begin()
            elif self._ending(self.active, q, q_next, self.held) != Ending.KEEP:
                self._close()
                self._choose()
        return self

    def score(self, optimum: float, at: int | None = None, episodes: int = 100) -> float:
        """Mean reward per step of the last episodes that were over at step ``at``, as a share of the optimum."""
        over = [each.reward / each.length for each in self.episodes if at is None or each.end <= at]
        return sum(over[-episodes:]) / min(len(over), episodes) / optimum

    def scores(self, optimum: float, at: Iterable[int]) -> list[float]:
        """``score`` at several steps, learning up to each."""
        return [self.run(steps).score(optimum, steps) for steps in at]
