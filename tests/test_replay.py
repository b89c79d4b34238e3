"""Replay: what is drawn is what was added, oldest experiences go first, marked rows get their share."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from t4nmtd_dist.errors import RunError
from t4nmtd_dist.learners.replay import Experiences, ReplayBuffer, Rows

OBSERVATION, STATES, ACTIONS = 3, 4, 2


def experiences(numbers: Rows) -> Experiences:
    """Experiences that can be told apart: every column is a function of the number."""
    floats = numbers.astype(np.float32)
    return Experiences(
        observations=np.stack([floats + column / 10 for column in range(OBSERVATION)], 1),
        q=(numbers % STATES).astype(np.int32),
        actions=np.stack([floats, -floats], 1),
        rewards=floats * 2,
        discounts=floats * 3,
        next_observations=np.stack([floats + 0.5 + column / 10 for column in range(OBSERVATION)], 1),
        next_q=((numbers + 1) % STATES).astype(np.int32),
        boundary=numbers % 3 == 0,
    )


def filled(capacity: int, sizes: list[int], *, seed: int = 0, marked_capacity: int | None = None) -> ReplayBuffer:
    replay = ReplayBuffer(capacity, OBSERVATION, STATES, ACTIONS, seed=seed, marked_capacity=marked_capacity)
    for size in sizes:
        replay.add(experiences(np.arange(replay.added, replay.added + size)))
    return replay


@settings(max_examples=50)
@given(st.integers(1, 20), st.lists(st.integers(0, 20), min_size=1, max_size=8), st.integers(0, 1000))
def test_every_drawn_row_is_a_whole_experience_of_the_newest_ones(capacity: int, sizes: list[int], seed: int) -> None:
    replay = filled(capacity, [min(size, capacity) for size in [*sizes, 1]], seed=seed)
    batch = replay.empty_batch(32)
    replay.sample(batch)
    numbers = np.rint(batch.rewards / 2).astype(np.int64)
    assert len(replay) == min(capacity, replay.added)
    assert (numbers >= replay.added - len(replay)).all()
    assert (numbers < replay.added).all()
    expected = experiences(numbers)
    one_hot = np.eye(STATES, dtype=np.float32)
    np.testing.assert_array_equal(batch.states, np.hstack([expected.observations, one_hot[expected.q]]))
    np.testing.assert_array_equal(batch.next_states, np.hstack([expected.next_observations, one_hot[expected.next_q]]))
    np.testing.assert_array_equal(batch.actions, expected.actions)
    np.testing.assert_array_equal(batch.discounts, expected.discounts)
    np.testing.assert_array_equal(batch.boundary_rows, np.flatnonzero(expected.boundary))
    np.testing.assert_array_equal(batch.boundary_observations, expected.next_observations[expected.boundary])
    np.testing.assert_array_equal(batch.boundary_q, expected.next_q[expected.boundary])
    np.testing.assert_array_equal(batch.tensors.states.numpy(), batch.states)


def test_a_batch_drawn_again_leaves_no_trace_of_the_one_before() -> None:
    replay = filled(10, [10])
    batch = replay.empty_batch(5)
    batch.rows[:] = [0, 1, 2, 3, 4]
    replay.fill(batch)
    batch.rows[:] = [1, 2, 3, 4, 5]
    replay.fill(batch)
    np.testing.assert_array_equal(batch.states[:, OBSERVATION:].argmax(1), [1, 2, 3, 0, 1])
    assert (batch.states[:, OBSERVATION:].sum(1) == 1).all()


def test_all_rows_are_drawn_alike() -> None:
    replay = filled(10, [10, 7])
    batch = replay.empty_batch(20_000)
    replay.sample(batch)
    assert (abs(np.bincount(batch.rows, minlength=10) / 2000 - 1) < 0.1).all()


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_marked_rows_fill_their_share_of_a_batch(share: float) -> None:
    replay = filled(1000, [1000])
    replay.mark(np.array([3, 4]))
    batch = replay.empty_batch(4000)
    replay.sample(batch, marked_share=share)
    assert np.isin(batch.rows, [3, 4]).mean() == pytest.approx(share, abs=0.01)


def test_without_marked_rows_the_batch_is_drawn_from_all() -> None:
    replay = filled(50, [50])
    batch = replay.empty_batch(1000)
    replay.sample(batch, marked_share=0.5)
    assert len(np.unique(batch.rows)) == 50


def test_marked_rows_that_were_overwritten_are_forgotten() -> None:
    replay = filled(10, [10])
    replay.mark(np.array([0, 1, 9]))
    replay.add(experiences(np.arange(10, 15)))
    assert replay.marked == 1
    batch = replay.empty_batch(40)
    replay.sample(batch, marked_share=1.0)
    assert (batch.rewards == 18).all()
    replay.mark(np.array([3, 4]))
    assert replay.marked == 1


def test_an_overwritten_row_behind_a_younger_one_is_drawn_from_all_instead() -> None:
    replay = filled(10, [10])
    replay.mark(np.array([9, 0]))
    replay.add(experiences(np.arange(10, 15)))
    assert replay.marked == 2
    batch = replay.empty_batch(4000)
    replay.sample(batch, marked_share=1.0)
    assert (batch.rewards >= 10).all()
    assert (batch.rewards == 18).mean() == pytest.approx(0.55, abs=0.05)


@given(st.lists(st.integers(0, 7), max_size=8))
def test_the_queue_of_marked_rows_keeps_the_newest(sizes: list[int]) -> None:
    replay = filled(100, [100], marked_capacity=5)
    marked: list[int] = []
    for size in sizes:
        fresh = list(range(len(marked), len(marked) + size))
        replay.mark(np.array(fresh, np.int64))
        marked += fresh
    np.testing.assert_array_equal(replay.state()["marked"], marked[-5:])


@pytest.mark.parametrize("sizes", [[4], [10, 10, 3]])
def test_a_restored_replay_draws_the_same_batches(sizes: list[int]) -> None:
    replay, restored = filled(10, sizes), filled(10, [2], seed=5)
    replay.mark(np.array([replay.added - 1, replay.added - 2]))
    drawn, again = replay.empty_batch(16), replay.empty_batch(16)
    replay.sample(drawn)
    state = {name: array.copy() for name, array in replay.state().items()}
    restored.load_state(state)
    for each, batch in ((replay, drawn), (restored, again)):
        each.add(experiences(np.arange(each.added, each.added + 3)))
        each.sample(batch, marked_share=0.5)
    np.testing.assert_array_equal(drawn.rows, again.rows)
    np.testing.assert_array_equal(drawn.states, again.states)


def test_a_state_of_another_capacity_is_refused() -> None:
    with pytest.raises(RunError, match="observations has shape"):
        filled(5, []).load_state(filled(10, [10]).state())


def test_wrong_columns_and_too_many_experiences_are_refused() -> None:
    replay = filled(5, [])
    with pytest.raises(ValueError, match="6 experiences for a replay of 5"):
        replay.add(experiences(np.arange(6)))
    other = ReplayBuffer(5, OBSERVATION + 1, STATES, ACTIONS, seed=0)
    with pytest.raises(ValueError, match="observations: expected shape"):
        other.add(experiences(np.arange(3)))
    with pytest.raises(ValueError, match="the replay is empty"):
        replay.sample(replay.empty_batch(2))
