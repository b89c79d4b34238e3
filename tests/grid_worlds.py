"""Grid worlds in which reward machines were first tried, and their tasks as formulas (Toro Icarte et al. 2022).

Maps are those of the authors' repository (RodrigoToroIcarte/reward_machines, commit 3116c2f); actions are 0 up,
1 right, 2 down, 3 left.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

from t4nmtd_dist.core.config import EnvironmentConfig, LearnerConfig, TaskConfig
from t4nmtd_dist.method.compiled import CompiledTask, compile_task

Cell = tuple[int, int]
HORIZON = 1000


@dataclass(frozen=True)
class World:
    """A small world by tables.

    Attributes:
        moves: the cell that each action leads to, [S][A].
        labels: what holds in each cell [S].
        start: the cell of the reset.
    """

    moves: Sequence[Sequence[int]]
    labels: Sequence[frozenset[str]]
    start: int

    def symbols(self, task: CompiledTask) -> list[int]:
        """The symbol that is read on entering each cell [S]."""
        return [task.dfa.symbol(labels) for labels in self.labels]


# Craft world: rows and columns from 1 within walls, the first row on top.

CRAFT_SIZE = 39
CRAFT_M1: Mapping[str, Sequence[Cell]] = {
    "a": [(2, 2), (2, 25), (18, 15), (23, 15), (34, 15)],
    "b": [(9, 37), (29, 31)],
    "c": [(5, 17), (25, 14)],
    "d": [(15, 30), (28, 39), (29, 32), (35, 1), (38, 7)],
    "e": [(7, 32), (8, 32)],
    "f": [(1, 29), (19, 2), (21, 2), (28, 2), (36, 15)],
    "g": [(19, 8), (27, 36)],
    "h": [(7, 12), (22, 33)],
}
CRAFT_M1_START = (20, 20)
CRAFT_M1_OPTIMUM = 0.01608448909869953
"""Mean reward per step of the optimal policy with epsilon 0.1, as the authors measured it on task 10."""


@cache
def craft_m1() -> World:
    """Map 1."""
    cells = [(row, column) for row in range(1, CRAFT_SIZE + 1) for column in range(1, CRAFT_SIZE + 1)]
    number = {cell: n for n, cell in enumerate(cells)}
    moves = [
        [number.get(to, n) for to in ((row - 1, column), (row, column + 1), (row + 1, column), (row, column - 1))]
        for n, (row, column) in enumerate(cells)
    ]
    things = {cell: letter for letter, places in CRAFT_M1.items() for cell in places}
    return World(moves, [frozenset(things.get(cell, "")) for cell in cells], number[CRAFT_M1_START])


# Office world: twelve by nine cells in rooms of three by three, x to the right, y upwards.

OFFICE = {
    (1, 1): "a", (1, 7): "b", (10, 7): "c", (10, 1): "d", (7, 4): "e", (8, 2): "f", (3, 6): "f", (4, 4): "g",
    (4, 1): "n", (7, 1): "n", (4, 7): "n", (7, 7): "n", (1, 4): "n", (10, 4): "n",
}  # fmt: skip
OFFICE_START = (2, 1)
OFFICE_OPTIMUM = 0.031344625839253674
"""The same for task 3."""

_DOORS = {((x, y), (x + 1, y)) for x in (2, 5, 8) for y in (1, 7)}
_DOORS |= {((x, 5), (x, 6)) for x in (1, 4, 7, 10)} | {((x, 2), (x, 3)) for x in (1, 10)}


@cache
def office() -> World:
    """The office as committed: rooms in the middle row have no doors to the left and right."""
    cells = [(x, y) for x in range(12) for y in range(9)]
    number = {cell: n for n, cell in enumerate(cells)}
    moves = [
        [
            number[to] if to in number and _passable((x, y), to) else n
            for to in ((x, y + 1), (x + 1, y), (x, y - 1), (x - 1, y))
        ]
        for n, (x, y) in enumerate(cells)
    ]
    return World(moves, [frozenset(OFFICE.get(cell, "")) for cell in cells], number[OFFICE_START])


def _passable(cell: Cell, to: Cell) -> bool:
    same_room = (cell[0] // 3, cell[1] // 3) == (to[0] // 3, to[1] // 3)
    return same_room or (cell, to) in _DOORS or (to, cell) in _DOORS


# Tasks

CRAFT_TASK_10 = "F(a & F(c & F(b & F h))) & F(f & F(b & F h))"
OFFICE_TASKS = {
    1: "F(f & F g) & G !n",
    2: "F(e & F g) & G !n",
    3: "F(e & F g) & F(f & F g) & G !n",
    4: "F(a & F(b & F(c & F d))) & G !n",
}


def grid_task(formula: str, learner: LearnerConfig, *, horizon: int = HORIZON) -> CompiledTask:
    """A task on a grid world, where no two letters hold together."""
    letters = tuple(sorted(set(re.findall("[a-z]", formula))))
    environment = EnvironmentConfig(id="grid", horizon=horizon)
    config = TaskConfig("grid", formula, letters, environment, "", (letters,), "first", learner=learner)
    return compile_task(config, translator="python")


def shortest_episode(world: World, task: CompiledTask) -> int:
    """Steps of the shortest accepted episode."""
    symbols, delta = world.symbols(task), task.dfa.delta.tolist()
    first = (world.start, task.dfa.initial)
    distance, queue = {first: 0}, deque([first])
    while queue:
        cell, q = queue.popleft()
        for to in world.moves[cell]:
            q_next = delta[q][symbols[to]]
            if q_next in task.dfa.accepting:
                return distance[cell, q] + 1
            if q_next not in task.dfa.error and (to, q_next) not in distance:
                distance[to, q_next] = distance[cell, q] + 1
                queue.append((to, q_next))
    raise AssertionError("the task cannot be solved")


# A corridor with ``a`` at the left end and ``b`` at the right one; actions are left and right.

CORRIDOR_TASK = "F(a & F b)"


def corridor(half: int = 5) -> World:
    """A start in the middle of ``2 * half + 1`` cells."""
    last = 2 * half
    moves = [[max(0, cell - 1), min(last, cell + 1)] for cell in range(last + 1)]
    labels = [frozenset({0: "a", last: "b"}.get(cell, "")) for cell in range(last + 1)]
    return World(moves, labels, half)
