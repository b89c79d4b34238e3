"""Rows of a peer's replay in which the own sub-task would have succeeded."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from small_sac import small_sac_task

from t4nmtd_dist.agents.common.peer_success_replay import PeerSuccesses, target_symbols
from t4nmtd_dist.agents.common.replay_buffer import BEFORE_SUCCESS, ReplayBuffer
from t4nmtd_dist.method.rewards import subtask_tables


@given(
    seed=st.integers(0, 2**32 - 1),
    steps=st.lists(st.integers(0, 60), min_size=1, max_size=4),
    capacity=st.integers(1, 90),
    ended=st.sampled_from([0.0, 0.02, 0.3]),
)
def test_peer_successes_are_the_rows_that_lead_to_a_symbol_within_their_attempt(
    seed: int, steps: list[int], capacity: int, ended: float
) -> None:
    """Looked at as the buffer grows; expected by going back from every row, one step after the other."""
    rng, count, useful = np.random.default_rng(seed), 2, np.array([False, True, False, True])
    replay, found = ReplayBuffer(capacity, count, 1, 1), PeerSuccesses(useful)
    past: list[tuple[NDArray[np.int64], NDArray[np.bool_]]] = []
    for some in steps:
        for _ in range(some):
            symbols, ends = (
                np.where(rng.random(count) < 0.02, rng.integers(4, size=count), 0),
                rng.random(count) < ended,
            )
            past.append((symbols, ends))
            zeros = np.zeros((count, 1), np.float32)
            states, no = np.zeros(count, np.int32), np.zeros(count, np.bool_)
            replay.add(zeros, states, zeros, symbols, zeros, no, ends, no)
        expected = set()
        oldest = max(0, len(past) - capacity)
        for copy in range(count):
            for t in (t for t in range(oldest, len(past)) if useful[past[t][0][copy]]):
                for s in range(t, max(oldest - 1, t - BEFORE_SUCCESS), -1):
                    if s < t and past[s][1][copy]:
                        break
                    expected.add((s % capacity) * count + copy)
        assert found.rows(replay).tolist() == sorted(expected)


def test_symbols_of_a_target_are_those_that_some_state_takes_to_one() -> None:
    task = small_sac_task()
    tables = subtask_tables(task.dfa, task.decomposition, "g1", task.rho, gamma=0.98, shaping="subtask")
    found = target_symbols(tables, task.dfa.delta)
    transitions = task.decomposition.subtasks["g1"]
    expected = [any(pair in transitions for pair in enumerate(column)) for column in task.dfa.delta.T.tolist()]
    assert found.tolist() == expected
    assert 0 < sum(expected) < len(expected)
