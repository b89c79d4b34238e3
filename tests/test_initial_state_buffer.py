"""Initial-state buffers: bounded, without repeats, readable from a cursor, and fairly sampled."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from t4nmtd_dist.method.start_states import InitialStateBuffer, StartState, sample_starts

additions = st.lists(st.tuples(st.integers(0, 3), st.integers(0, 9)), max_size=40)


def state(number: int) -> np.ndarray:
    return np.array([number, -number])


def filled(entries: list[tuple[int, int]], capacity: int = 100) -> InitialStateBuffer:
    buffer = InitialStateBuffer(capacity)
    for q, number in entries:
        buffer.add(q, state(number))
    return buffer


def contents(buffer: InitialStateBuffer) -> list[tuple[int, int]]:
    return [(q, int(found[0])) for _, q, found in buffer.since(0, 10**6)]


@given(additions, st.integers(1, 5))
def test_it_is_a_bounded_queue_per_state_without_repeats(entries: list[tuple[int, int]], capacity: int) -> None:
    buffer = InitialStateBuffer(capacity)
    model: dict[int, list[int]] = {}
    for q, number in entries:
        queue = model.setdefault(q, [])
        assert buffer.add(q, state(number)) == (number not in queue)
        if number not in queue:
            queue.append(number)
            del queue[:-capacity]
    assert buffer.states_present() == sorted(model)
    assert len(buffer) == sum(map(len, model.values()))
    for q, queue in model.items():
        assert [number for found, number in contents(buffer) if found == q] == queue
        assert buffer.count(q) == len(queue)


def test_an_entry_is_a_copy() -> None:
    buffer, given_state = InitialStateBuffer(3), state(1)
    buffer.add(0, given_state)
    given_state[:] = 9
    assert contents(buffer) == [(0, 1)]


@given(additions, st.integers(1, 6), st.integers(1, 5))
def test_reading_on_from_the_cursor_gives_every_entry_once_and_in_order(
    entries: list[tuple[int, int]], portion: int, capacity: int
) -> None:
    buffer = filled(entries, capacity)
    cursor, read = 0, []
    while fresh := buffer.since(cursor, portion):
        assert len(fresh) <= portion
        assert [number for number, _, _ in fresh] == sorted(number for number, _, _ in fresh)
        read += [(q, int(found[0])) for _, q, found in fresh]
        cursor = fresh[-1][0]
    assert read == contents(buffer)
    assert buffer.since(cursor, portion) == []
    if buffer.add(0, state(77)):
        assert [(q, int(found[0])) for _, q, found in buffer.since(cursor, portion)] == [(0, 77)]


@given(additions)
def test_the_cursor_only_grows(entries: list[tuple[int, int]]) -> None:
    buffer, last = InitialStateBuffer(2), 0
    for q, number in entries:
        added = buffer.add(q, state(number))
        assert buffer.cursor == last + added
        last = buffer.cursor


def shares(buffer: InitialStateBuffer, reset_q: int | None, draws: int = 8000) -> dict[tuple[int, int | None], float]:
    starts = sample_starts(buffer, reset_q, draws, np.random.default_rng(1))
    counts = Counter((start.q, None if start.state is None else int(start.state[0])) for start in starts)
    return {key: count / draws for key, count in counts.items()}


def test_starts_are_uniform_over_dfa_states_then_within() -> None:
    buffer = filled([(1, 0), (2, 1), (2, 2), (2, 3), (2, 4)])
    expected = {(1, 0): 0.5} | {(2, number): 0.125 for number in (1, 2, 3, 4)}
    assert shares(buffer, None) == pytest.approx(expected, abs=0.025)


def test_the_reset_is_a_standing_entry_of_the_initial_state() -> None:
    found = shares(filled([(0, 1), (0, 2), (0, 3), (1, 4)]), 0)
    assert found[1, 4] == pytest.approx(0.5, abs=0.025)
    assert found[0, None] > 0.1, "fresh resets keep coming"
    handed = [found[0, number] for number in (1, 2, 3)]
    assert handed == pytest.approx([sum(handed) / 3] * 3, abs=0.025)
    assert sum(handed) > 0.1


def test_the_reset_alone_is_enough_to_begin() -> None:
    assert sample_starts(InitialStateBuffer(3), 0, 2, np.random.default_rng(0)) == [StartState(0, None)] * 2


def test_without_any_entry_there_is_nowhere_to_begin() -> None:
    assert list(sample_starts(InitialStateBuffer(3), None, 5, np.random.default_rng(0))) == []
