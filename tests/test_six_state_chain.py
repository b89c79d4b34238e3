"""h-DQN's bookkeeping on the chain of Kulkarni et al. (2016), in tables.

States 1 to 6, start in 2. *Right* succeeds with probability 0.5 and leads left otherwise. The episode ends in 1, with
reward 1 if 6 was visited and 0.01 if not. Goals are the states. The optimum is 0.2 * 1 + 0.8 * 0.01 = 0.208.
"""

from __future__ import annotations

import random

import numpy as np
import pytest
from tabular import UpperTable

from t4nmtd_dist.method.options import LinearSchedule, OpenOptions

pytestmark = pytest.mark.slow

START, FIRST, LAST = 2, 1, 6
GOALS = [str(state) for state in range(FIRST, LAST + 1)]
EPISODES = 12_000
ROWS = np.zeros(1, np.int64)


class Chain:
    """Two levels of tables.

    Args:
        late: the upper level takes an option's end for the state in which it was chosen.
        inverted: the lower level explores where it should exploit.
    """

    def __init__(self, seed: int, *, late: bool = False, inverted: bool = False) -> None:
        self.random, self._late, self._inverted = random.Random(seed), late, inverted
        self._open = OpenOptions(1, 1, GOALS, np.ones((2, len(GOALS)), np.bool_), gamma=1.0, smdp=False)
        self.upper = UpperTable(len(GOALS), rate=0.02, initial=0.0, scale=1.0)
        self.lower = [[[0.0, 0.0] for _ in range(LAST + 1)] for _ in GOALS]
        self._explores = LinearSchedule(1.0, 0.1, 8_000)
        self._chosen = [0] * len(GOALS)
        self._decisions = 0

    def episode(self, *, learns: bool = True) -> float:
        """The reward of one episode."""
        state, visited = START, 0
        while state != FIRST:
            goal = self._choose(state, visited, learns)
            before = state
            while state not in (FIRST, goal + 1) or state == before:
                action = self._act(goal, state, learns)
                after = state + 1 if action and self.random.random() < 0.5 and state < LAST else state - 1
                visited = int(visited or after == LAST)
                if learns:
                    self._learn(goal, state, action, after)
                state, before = after, 0
            paid = (1.0 if visited else 0.01) if state == FIRST else 0.0
            if learns:
                self._close(state, visited, paid)
        return paid

    def _choose(self, state: int, visited: int, learns: bool) -> int:
        values = self.upper.row(state, visited)
        share = self._explores.after(self._decisions) if learns else 0.0
        others = [goal for goal in range(len(GOALS)) if goal + FIRST != state]
        greedy = max(others, key=lambda goal: (values[goal], self.random.random()))
        goal = self.random.choice(others) if self.random.random() < share else greedy
        if learns:
            self._decisions += 1
            self._chosen[goal] += 1
            self._open.open(ROWS, np.array([[state]], np.float32), np.array([visited], np.int32), [GOALS[goal]])
        return goal

    def _act(self, goal: int, state: int, learns: bool) -> int:
        share = LinearSchedule(1.0, 0.1, 2_000).after(self._chosen[goal]) if learns else 0.0
        explores = self.random.random() < (1.0 - share if self._inverted and learns else share)
        left, right = self.lower[goal][state]
        return self.random.randrange(2) if explores or left == right else int(right > left)

    def _learn(self, goal: int, state: int, action: int, after: int) -> None:
        reached = after == goal + FIRST
        follows = 0.0 if reached or after == FIRST else max(self.lower[goal][after])
        row = self.lower[goal][state]
        row[action] += 0.05 * (reached + 0.99 * follows - row[action])

    def _close(self, state: int, visited: int, paid: float) -> None:
        self._open.earn(np.array([paid]))
        observations, q = np.array([[state]], np.float32), np.array([visited], np.int32)
        closed = self._open.close(ROWS, observations, q, np.array([state == FIRST]))
        if self._late:
            closed.observations[:], closed.q[:] = observations, q
        self.upper.learn(closed)


def trained(seed: int, **mistakes: bool) -> tuple[float, float]:
    """Mean reward of the last 1,000 training episodes, and greedily."""
    chain = Chain(seed, **mistakes)
    rewards = [chain.episode() for _ in range(EPISODES)]
    greedy = [chain.episode(learns=False) for _ in range(4_000)]
    return float(np.mean(rewards[-1000:])), float(np.mean(greedy))


def test_goals_lead_to_the_far_end_and_back() -> None:
    found = [trained(seed) for seed in range(6)]
    assert sum(last >= 0.12 and greedy >= 0.18 for last, greedy in found) >= 5, found


@pytest.mark.parametrize("seed", [0, 1])
def test_the_state_after_the_goal_is_no_place_to_choose_it(seed: int) -> None:
    last, greedy = trained(seed, late=True)
    assert greedy < 0.12
    assert last < 0.12


def test_exploring_the_wrong_way_round_earns_little() -> None:
    last, _ = trained(0, inverted=True)
    assert last < 0.06
