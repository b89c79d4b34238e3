"""Packs and unpacks progress and start states as message arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import ProtocolError
from t4nmtd_dist.method.protocol import Change
from t4nmtd_dist.wire.limits import STARTS_BYTES, most_starts

MOST_CHANGES = 1_000_000
MOST_STARTS = 256
LARGEST_REWARD = 1e9

Arrays = Mapping[str, NDArray[Any]]
Start = tuple[int, NDArray[Any]]


@dataclass(frozen=True)
class PackedProgress:
    """The content of a Sync's arrays.

    Attributes:
        changes: DFA state changes, in order.
        starts: start states (q', snapshot).
    """

    changes: Sequence[Change] = field(default_factory=list)
    starts: Sequence[Start] = field(default_factory=list)


def pack_progress(changes: Sequence[Change], starts: Sequence[Start]) -> dict[str, NDArray[Any]]:
    """Arrays ``progress.*`` and ``starts.*`` of a Sync; empty inputs add no arrays."""
    return pack_changes(changes) | pack_starts(starts)


def unpack_progress(arrays: Arrays, dfa_states: int, like: NDArray[Any] | None = None) -> PackedProgress:
    """Read ``progress.*`` and ``starts.*`` of a Sync.

    Args:
        arrays: of the message.
        dfa_states: |Q|.
        like: an earlier start state, if any, whose dtype and size all must share.

    Raises:
        ProtocolError: if shapes or dtypes do not match, a DFA state does not exist, or a number is out of range.
    """
    return PackedProgress(unpack_changes(arrays, dfa_states), unpack_starts(arrays, dfa_states, like))


def pack_changes(changes: Sequence[Change]) -> dict[str, NDArray[Any]]:
    """Arrays ``progress.q`` int32 [n, 3] and ``progress.reward`` float64 [n]; none without changes."""
    if not changes:
        return {}
    return {
        "progress.q": np.array([(q, to, steps) for q, to, steps, _ in changes], np.int32),
        "progress.reward": np.array([reward for *_, reward in changes], np.float64),
    }


def unpack_changes(arrays: Arrays, dfa_states: int) -> list[Change]:
    """Read ``progress.*``.

    Raises:
        ProtocolError: see ``unpack_progress``.
    """
    q = arrays.get("progress.q", np.empty((0, 3), np.int32))
    rewards = arrays.get("progress.reward", np.empty(0))
    _check(q.ndim == 2 and q.shape[1] == 3, f"progress.q has shape {q.shape}, expected [n, 3]")
    _check(len(q) <= MOST_CHANGES, f"progress.q holds {len(q)} changes; at most {MOST_CHANGES} are allowed")
    _check_rewards(rewards, len(q))
    _check(q.dtype == np.int32, f"progress.q is {q.dtype}, expected int32")
    _check(bool((q[:, 2] >= 0).all()), "progress.q holds a negative number of steps")
    _check_states(q[:, 0], 0, dfa_states)
    _check_states(q[:, 1], -1, dfa_states)
    rows = zip(q.tolist(), rewards.tolist(), strict=True)
    return [Change(before, after, steps, reward) for (before, after, steps), reward in rows]


def _check_rewards(rewards: NDArray[Any], count: int) -> None:
    _check(rewards.dtype.kind == "f", f"progress.reward is {rewards.dtype}, expected float64")
    _check(rewards.shape == (count,), "progress.reward and progress.q differ in length")
    _check(bool(np.isfinite(rewards).all()), "progress.reward holds a number that is not finite")
    _check(bool((abs(rewards) <= LARGEST_REWARD).all()), f"progress.reward exceeds {LARGEST_REWARD:g}")


def newest_starts(starts: Sequence[Start], count: int) -> list[Start]:
    """The newest distinct start states, oldest first: at most ``count`` and what fits into a message."""
    distinct = list({(q, state.tobytes()): (q, state) for q, state in starts}.values())
    return distinct[-most_starts(count, distinct[-1][1].nbytes) :] if distinct else []


def pack_starts(starts: Sequence[Start]) -> dict[str, NDArray[Any]]:
    """Arrays ``starts.q`` int32 [m] and ``starts.state`` [m, s]; none without start states."""
    if not starts:
        return {}
    return {
        "starts.q": np.array([q for q, _ in starts], np.int32),
        "starts.state": np.stack([state for _, state in starts]),
    }


def unpack_starts(arrays: Arrays, dfa_states: int, like: NDArray[Any] | None = None) -> list[Start]:
    """Read ``starts.*`` of a Sync or a SyncReply.

    Raises:
        ProtocolError: see ``unpack_progress``.
    """
    q, states = arrays.get("starts.q", np.empty(0, np.int32)), arrays.get("starts.state", np.empty((0, 0)))
    _check(q.ndim == 1 and states.ndim == 2, "starts.q must be [m] and starts.state [m, s]")
    _check(len(states) <= MOST_STARTS, f"starts.state holds {len(states)} states; at most {MOST_STARTS} are allowed")
    size = states[:1].nbytes
    _check(size <= STARTS_BYTES, f"starts.state holds states of {size} bytes; at most {STARTS_BYTES} are allowed")
    _check(len(q) == len(states), "starts.q and starts.state differ in length")
    _check_states(q, 0, dfa_states)
    if len(states) and like is not None:
        alike = states.dtype == like.dtype and states.shape[1:] == like.shape
        _check(alike, f"starts.state holds {states.dtype} {states.shape[1:]}, before {like.dtype} {like.shape}")
    return list(zip(q.tolist(), states, strict=True))


def _check(holds: bool, text: str) -> None:
    if not holds:
        raise ProtocolError(text)


def _check_states(states: NDArray[Any], lowest: int, count: int) -> None:
    _check(
        states.dtype.kind == "i" and bool(((states >= lowest) & (states < count)).all()),
        f"a DFA state is outside {lowest}..{count - 1}",
    )
