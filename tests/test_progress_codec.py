"""Progress and start states survive the wire."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import ProtocolError
from t4nmtd_dist.wire.codec import Envelope, decode, encode
from t4nmtd_dist.wire.limits import STARTS_BYTES
from t4nmtd_dist.wire.messages import LearnerStats, Sync
from t4nmtd_dist.wire.progress import (
    LARGEST_REWARD,
    MOST_STARTS,
    Change,
    Start,
    newest_starts,
    pack_changes,
    pack_progress,
    pack_starts,
    unpack_changes,
    unpack_progress,
    unpack_starts,
)

DFA_STATES = 7
SYNC = Sync(pid="g", epoch=1, sequence=1, version=0, start_cursor=0, stats=LearnerStats())
CHANGES = st.lists(
    st.tuples(
        st.integers(0, DFA_STATES - 1),
        st.integers(-1, DFA_STATES - 1),
        st.integers(0, 2**31 - 1),
        st.floats(-LARGEST_REWARD, LARGEST_REWARD),
    ),
    max_size=20,
)


@st.composite
def some_starts(draw: st.DrawFn) -> list[Start]:
    """Start states of one run: snapshots of one type and size."""
    dtype, shape = draw(st.sampled_from(["<f4", "<f8", "<i8", "|u1"])), draw(array_shapes(max_dims=1, max_side=9))
    snapshots = draw(st.lists(arrays(dtype, shape, elements={"allow_nan": False} if dtype[1] == "f" else None)))
    return [(draw(st.integers(0, DFA_STATES - 1)), snapshot) for snapshot in snapshots]


def travelled(packed: dict[str, NDArray[Any]]) -> Any:
    """The arrays as the other side of a connection sees them."""
    return decode(encode(Envelope(SYNC, packed))).arrays


def bytes_of(starts: list[Start]) -> list[tuple[int, str, bytes]]:
    return [(q, state.dtype.str, state.tobytes()) for q, state in starts]


@given(CHANGES)
def test_changes_come_back_as_they_were_packed(changes: list[Change]) -> None:
    assert unpack_changes(travelled(pack_changes(changes)), DFA_STATES) == changes


@given(some_starts())
def test_start_states_come_back_as_they_were_packed(starts: list[Start]) -> None:
    like = starts[0][1] if starts else None
    assert bytes_of(unpack_starts(travelled(pack_starts(starts)), DFA_STATES, like)) == bytes_of(starts)


@given(CHANGES, some_starts())
def test_progress_comes_back_as_it_was_packed(changes: list[Change], starts: list[Start]) -> None:
    progress = unpack_progress(travelled(pack_progress(changes, starts)), DFA_STATES)
    assert progress.changes == changes
    assert bytes_of(list(progress.starts)) == bytes_of(starts)


def test_nothing_takes_no_arrays() -> None:
    assert pack_progress([], []) == {}
    assert unpack_progress({}, DFA_STATES).changes == unpack_progress({}, DFA_STATES).starts == []


@given(some_starts(), st.integers(1, 5))
def test_the_newest_distinct_start_states_are_kept_oldest_first(starts: list[Start], count: int) -> None:
    kept, distinct = bytes_of(newest_starts(starts, count)), dict.fromkeys(bytes_of(starts))
    assert len(kept) == min(count, len(distinct)) == len(set(kept))
    assert kept == list(distinct)[len(distinct) - len(kept) :]


def test_start_states_are_cut_to_what_a_message_takes() -> None:
    large = [(0, np.full(STARTS_BYTES // 2, number, np.uint8)) for number in range(5)]
    assert bytes_of(newest_starts(large, 64)) == bytes_of(large[-2:])


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"progress.q": np.zeros((2, 2), np.int32)}, r"expected \[n, 3\]"),
        ({"progress.q": np.zeros((2, 3), np.int32)}, "differ in length"),
        ({"progress.q": np.full((1, 3), DFA_STATES, np.int32), "progress.reward": np.zeros(1)}, "outside 0"),
        ({"progress.q": np.zeros((1, 3), np.int64), "progress.reward": np.zeros(1)}, "expected int32"),
        ({"progress.q": np.zeros((1, 3), np.int32), "progress.reward": np.full(1, np.nan)}, "not finite"),
        ({"progress.q": np.zeros((1, 3), np.int32), "progress.reward": np.full(1, 1e10)}, "exceeds"),
        ({"progress.q": np.array([[0, 0, -1]], np.int32), "progress.reward": np.zeros(1)}, "negative number of steps"),
        ({"starts.q": np.zeros(1, np.int32)}, "differ in length"),
        ({"starts.q": np.full(1, -1, np.int32), "starts.state": np.zeros((1, 2))}, "outside 0"),
        ({"starts.q": np.zeros(MOST_STARTS + 1, np.int32), "starts.state": np.zeros((MOST_STARTS + 1, 1))}, "at most"),
    ],
)
def test_what_cannot_be_progress_is_refused_by_its_reason(wrong: dict[str, NDArray[Any]], text: str) -> None:
    with pytest.raises(ProtocolError, match=text):
        unpack_progress(wrong, DFA_STATES)


def test_start_states_of_another_type_or_size_are_refused() -> None:
    packed = pack_starts([(0, np.zeros(3))])
    for like in (np.zeros(3, np.float32), np.zeros(4)):
        with pytest.raises(ProtocolError, match="before"):
            unpack_starts(packed, DFA_STATES, like)
