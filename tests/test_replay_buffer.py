"""Replay of symbols: n-step returns against a slow reference, steps before successes, and an exact round trip."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.replay_buffer import BEFORE_SUCCESS, ReplayBuffer, Returns, RowSet
from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.method.rewards import SubtaskTables

SIZE, ACTIONS = 3, 2


@dataclass(frozen=True)
class Automaton:
    """A transition table, and what a sub-task makes of it, drawn at random."""

    delta: NDArray[np.int32]
    tables: SubtaskTables

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Automaton:
        states, symbols = rng.integers(2, 6), rng.integers(1, 4)
        delta = rng.integers(states, size=(states, symbols)).astype(np.int32)
        stays = rng.random(delta.shape) < 0.6  # long stays, so that returns are long too
        delta = np.where(stays, np.arange(states)[:, None], delta).astype(np.int32)
        kind = rng.choice(3, size=states, p=(0.6, 0.2, 0.2))
        target = rng.random((states, states)) < 0.3
        reward, kept = rng.normal(size=(states, states)), rng.normal(size=states)
        return cls(delta, SubtaskTables(target, target.any(axis=1), kind == 1, kind == 2, reward, kept))


@dataclass(frozen=True)
class Step:
    """One step of one copy; ``number`` is what its observations hold, never the same twice."""

    number: int
    symbol: int
    terminated: bool
    ended: bool
    reached: bool


@dataclass
class History:
    """A replay buffer, and beside it everything that was ever added: ``steps[t][copy]``."""

    replay: ReplayBuffer
    capacity: int
    steps: list[list[Step]] = field(default_factory=list)

    @property
    def count(self) -> int:
        return self.replay.observations.shape[0] // self.capacity

    def row(self, t: int, copy: int) -> int:
        return (t % self.capacity) * self.count + copy

    def stored(self) -> list[tuple[int, int]]:
        """(t, copy) of everything still in the ring."""
        first = max(0, len(self.steps) - self.capacity)
        return [(t, copy) for t in range(first, len(self.steps)) for copy in range(self.count)]

    def before_success(self) -> set[int]:
        """Rows still in the ring of the last steps of attempts that succeeded."""
        rows = set()
        for t, copy in ((t, c) for t, steps in enumerate(self.steps) for c, step in enumerate(steps) if step.reached):
            for s in range(t, max(t - BEFORE_SUCCESS, -1), -1):
                if s < t and self.steps[s][copy].ended:
                    break
                if s >= len(self.steps) - self.capacity:
                    rows.add(self.row(s, copy))
        return rows

    def add(self, rng: np.random.Generator, symbols: int, *, end: float) -> None:
        count, t = self.count, len(self.steps)
        ended = rng.random(count) < end
        terminated, reached = ended & (rng.random(count) < 0.4), ended & (rng.random(count) < 0.4)
        numbers, read = t * count + np.arange(count), rng.integers(symbols, size=count)
        observations = np.repeat(numbers[:, None], SIZE, axis=1).astype(np.float32)
        actions = rng.uniform(-1, 1, (count, ACTIONS)).astype(np.float32)
        self.replay.add(
            observations, np.zeros(count, np.int32), actions, read, observations + 0.5, terminated, ended, reached
        )
        columns = (numbers, read, terminated, ended, reached)
        self.steps.append([Step(*values) for values in zip(*(c.tolist() for c in columns), strict=True)])


def history(
    rng: np.random.Generator, steps: int, *, capacity: int, count: int, symbols: int, end: float = 0.2
) -> History:
    made = History(ReplayBuffer(capacity, count, SIZE, ACTIONS), capacity)
    for _ in range(steps):
        made.add(rng, symbols, end=end)
    return made


def expected_return(
    past: History, automaton: Automaton, t: int, copy: int, q: int, gamma: float, n: int
) -> tuple[float, float, int, int, bool]:
    """Reward, discount, number of the last step, q' and boundary of <t, copy> read in q, one step after the other."""
    tables, total = automaton.tables, 0.0
    for k in range(n):
        step = past.steps[t + k][copy]
        q_next = int(automaton.delta[q, step.symbol])
        total += gamma**k * float(tables.reward[q, q_next] - step.terminated * tables.carried_potential[q_next])
        if q_next != q or step.ended or t + k + 1 == len(past.steps):
            break
    over = bool(tables.accepting[q_next] or tables.error[q_next] or step.terminated)
    return total, 0.0 if over else gamma ** (k + 1), step.number, q_next, q_next != q and not over


seeds = st.integers(0, 2**32 - 1)


@settings(max_examples=150, deadline=None)
@given(
    seed=seeds,
    steps=st.integers(1, 40),
    capacity=st.integers(1, 25),
    count=st.integers(1, 3),
    n=st.integers(1, 8),
    gamma=st.sampled_from([0.0, 0.5, 0.99, 1.0]),
    end=st.sampled_from([0.0, 0.1, 0.5]),
)
def test_returns_are_those_of_a_slow_reference_in_whatever_state_they_are_read(
    seed: int, steps: int, capacity: int, count: int, n: int, gamma: float, end: float
) -> None:
    rng = np.random.default_rng(seed)
    automaton = Automaton.drawn(rng)
    states, symbols = automaton.delta.shape
    past = history(rng, steps, capacity=capacity, count=count, symbols=symbols, end=end)
    places = past.stored()
    rows = np.array([past.row(t, copy) for t, copy in places])
    q = rng.integers(states, size=len(rows)).astype(np.int32)
    found = past.replay.returns(rows, q, automaton.tables, automaton.delta, gamma, n)
    last = past.replay.next_observations[found.last, 0]
    assert (past.replay.next_observations[found.last] == last[:, None]).all()
    for i, (t, copy) in enumerate(places):
        reward, discount, number, q_next, boundary = expected_return(past, automaton, t, copy, int(q[i]), gamma, n)
        assert found.reward[i] == pytest.approx(reward, abs=1e-9)
        assert found.discount[i] == pytest.approx(discount, abs=1e-12)
        assert (last[i], found.q_next[i], found.boundary[i]) == (number + 0.5, q_next, boundary)


# Where a return stops, one case each: an automaton that stays in 0, goes on to 1, accepts in 2 or fails in 3

STAY, GO, ACCEPT, FAIL = range(4)
REWARD = np.zeros((4, 4))
REWARD[0] = [1.0, 10.0, 100.0, -5.0]
CHAIN = Automaton(
    np.array([[0, 1, 2, 3]] + [[q] * 4 for q in (1, 2, 3)], np.int32),
    SubtaskTables(
        target=REWARD > 5,
        available=np.array([True, True, False, False]),
        accepting=np.array([False, False, True, False]),
        error=np.array([False, False, False, True]),
        reward=REWARD,
        carried_potential=np.array([0.25, 0.0, 0.0, 0.0]),
    ),
)


def chain_returns(
    symbols: list[int], *, n: int, ends: tuple[int, ...] = (), terminations: tuple[int, ...] = ()
) -> Returns:
    """Returns with gamma 0.5 of all steps of one copy, read in state 0."""
    replay = ReplayBuffer(20, 1, SIZE, ACTIONS)
    for t, symbol in enumerate(symbols):
        observations, actions = np.full((1, SIZE), t, np.float32), np.zeros((1, ACTIONS), np.float32)
        terminated, ended = np.array([t in terminations]), np.array([t in ends or t in terminations])
        read, q, reached = np.array([symbol]), np.zeros(1, np.int32), np.zeros(1, np.bool_)
        replay.add(observations, q, actions, read, observations, terminated, ended, reached)
    rows = np.arange(len(symbols))
    return replay.returns(rows, np.zeros(len(rows), np.int32), CHAIN.tables, CHAIN.delta, 0.5, n)


def test_a_return_stops_where_the_state_changes_and_the_value_there_is_the_peers() -> None:
    found = chain_returns([STAY, GO, STAY, STAY], n=4)
    assert found.reward.tolist() == [1 + 5, 10, 1.5, 1]
    assert found.discount.tolist() == [0.25, 0.5, 0.25, 0.5]
    assert (found.last.tolist(), found.q_next.tolist()) == ([1, 1, 3, 3], [1, 1, 0, 0])
    assert found.boundary.tolist() == [True, True, False, False]


@pytest.mark.parametrize(("symbol", "gain"), [(ACCEPT, 100.0), (FAIL, -5.0)])
def test_acceptance_and_errors_are_worth_nothing_and_nobodys(symbol: int, gain: float) -> None:
    found = chain_returns([STAY, symbol, STAY], n=4, ends=(1,))
    assert found.reward[:2].tolist() == [1 + gain / 2, gain]
    assert found.discount[:2].tolist() == [0, 0]
    assert not found.boundary.any()


def test_a_time_out_stops_a_return_and_bootstraps() -> None:
    found = chain_returns([STAY, STAY, STAY], n=4, ends=(1,))
    assert found.discount.tolist() == [0.25, 0.5, 0.5]
    assert found.last.tolist() == [1, 1, 2]


def test_an_environment_that_ends_is_terminal_and_gives_the_kept_potential_back() -> None:
    found = chain_returns([STAY, STAY, STAY], n=4, terminations=(1,))
    assert found.discount.tolist() == [0, 0, 0.5]
    assert found.reward.tolist() == [1 + 0.375, 0.75, 1]


def test_a_change_on_the_step_on_which_the_environment_ends_is_no_boundary() -> None:
    found = chain_returns([GO], n=4, terminations=(0,))
    assert (found.discount[0], found.boundary[0]) == (0, False)


# Steps before successes, and sampling


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(
    seed=seeds,
    steps=st.integers(1, 150),
    capacity=st.integers(1, 90),
    count=st.integers(1, 3),
    end=st.sampled_from([0.005, 0.02, 0.3]),
)
def test_steps_before_successes_are_those_of_the_attempt_that_are_still_there(
    seed: int, steps: int, capacity: int, count: int, end: float
) -> None:
    rng = np.random.default_rng(seed)
    past = history(rng, steps, capacity=capacity, count=count, symbols=2, end=end)
    expected = past.before_success()
    assert sorted(past.replay.state_dict()["before_success"]) == sorted(expected)
    rows = past.replay.sample(20, 1.0, rng)
    stored = {past.row(t, copy) for t, copy in past.stored()}
    assert set(rows.tolist()) <= (expected or stored)


def test_a_share_of_a_batch_comes_from_before_successes_and_the_rest_from_everywhere() -> None:
    rng = np.random.default_rng(0)
    past = history(rng, 300, capacity=200, count=2, symbols=2, end=0.02)
    special, all_rows = past.before_success(), len(past.replay)
    assert 0 < len(special) < all_rows
    rows = past.replay.sample(8000, 0.25, rng)
    assert set(rows[:2000].tolist()) == special
    assert set(rows[2000:].tolist()) == set(range(all_rows))
    for part, among in ((rows[:2000], len(special)), (rows[2000:], all_rows)):
        counts = np.bincount(part, minlength=all_rows)
        assert counts.max() < len(part) / among + 6 * np.sqrt(len(part) / among) + 6
    assert set(past.replay.sample(8000, 0.0, rng).tolist()) == set(range(all_rows))


def test_without_successes_all_rows_are_drawn_from_what_is_filled() -> None:
    rng = np.random.default_rng(0)
    past = history(rng, 7, capacity=50, count=2, symbols=2, end=0.0)
    assert set(past.replay.sample(1000, 0.5, rng).tolist()) == set(range(14))


@settings(max_examples=60)
@given(st.lists(st.tuples(st.booleans(), st.sets(st.integers(0, 9))), max_size=20))
def test_a_set_of_rows_holds_what_a_set_would(changes: list[tuple[bool, set[int]]]) -> None:
    found, expected = RowSet(10), set[int]()
    for adds, rows in changes:
        change = np.array(sorted(rows), np.int64)
        if adds:
            found.add(change)
            expected |= rows
        else:
            found.discard(change)
            expected -= rows
        assert sorted(found.members) == sorted(expected)
        assert len(found) == len(expected)
        if expected:
            assert set(found.draw(5, np.random.default_rng(0)).tolist()) <= expected


# Round trip


def frozen(replay: ReplayBuffer) -> dict[str, NDArray[Any]]:
    return {name: array.copy() for name, array in replay.state_dict().items()}


def equal(a: dict[str, NDArray[Any]], b: dict[str, NDArray[Any]]) -> bool:
    same = (x.dtype == b[k].dtype and x.shape == b[k].shape and x.tobytes() == b[k].tobytes() for k, x in a.items())
    return a.keys() == b.keys() and all(same)


@settings(max_examples=60, deadline=None)
@given(seed=seeds, steps=st.integers(0, 40), capacity=st.integers(1, 25), count=st.integers(1, 3))
def test_what_was_stored_and_loaded_goes_on_in_the_same_way(seed: int, steps: int, capacity: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    first = history(rng, steps, capacity=capacity, count=count, symbols=3)
    second = History(ReplayBuffer(capacity, count, SIZE, ACTIONS), capacity, list(first.steps))
    second.replay.load_state_dict(frozen(first.replay))
    assert equal(first.replay.state_dict(), second.replay.state_dict())
    for past in (first, second):
        rng = np.random.default_rng(7)
        for _ in range(30):
            past.add(rng, 3, end=0.1)
    assert equal(first.replay.state_dict(), second.replay.state_dict())
    draws = [past.replay.sample(50, 0.5, np.random.default_rng(8)) for past in (first, second)]
    assert np.array_equal(*draws)


@pytest.mark.parametrize(("capacity", "count", "size"), [(8, 2, SIZE), (10, 3, SIZE), (10, 2, SIZE + 1)])
def test_a_replay_of_another_size_is_refused(capacity: int, count: int, size: int) -> None:
    past = history(np.random.default_rng(0), 12, capacity=10, count=2, symbols=2)
    with pytest.raises(RunError, match="has shape"):
        ReplayBuffer(capacity, count, size, ACTIONS).load_state_dict(past.replay.state_dict())
