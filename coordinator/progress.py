"""The arrays of a learner's progress, checked and unpacked, and start states packed for a reply."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import ProtocolError
from t4nmtd_dist.wire.limits import STARTS_BYTES

MOST_CHANGES = 1_000_000
MOST_STARTS = 256
LARGEST_REWARD = 1e9


@dataclass(frozen=True)
class ReceivedProgress:
    """Changes as (q, q' or negative, steps, reward) in order, and start states as (q', snapshot)."""

    changes: list[tuple[int, int, int, float]]
    starts: list[tuple[int, NDArray[Any]]]


def read_progress(
    arrays: Mapping[str, NDArray[Any]], dfa_states: int, snapshot: NDArray[Any] | None = None
) -> ReceivedProgress:
    """Read ``progress.*`` and ``starts.*`` of a Sync message.

    Args:
        arrays: of the message.
        dfa_states: |Q|.
        snapshot: a start state received before, if any: all of a run are alike in type and size.

    Raises:
        ProtocolError: if shapes do not fit together, a DFA state does not exist, or a number is out of range.
    """
    changes = arrays.get("progress.q", np.empty((0, 3), np.int32))
    rewards = arrays.get("progress.reward", np.empty(0))
    _check(changes.ndim == 2 and changes.shape[1] == 3, f"progress.q has shape {changes.shape}, expected [n, 3]")
    _check(len(changes) <= MOST_CHANGES, f"progress.q holds {len(changes)} changes; at most {MOST_CHANGES} are allowed")
    _check(rewards.dtype.kind == "f", f"progress.reward is {rewards.dtype}, expected float64")
    _check(rewards.shape == changes.shape[:1], "progress.reward and progress.q differ in length")
    _check(bool(np.isfinite(rewards).all()), "progress.reward holds a number that is not finite")
    _check(bool((abs(rewards) <= LARGEST_REWARD).all()), f"progress.reward exceeds {LARGEST_REWARD:g}")
    _check(changes.dtype == np.int32, f"progress.q is {changes.dtype}, expected int32")
    _check(bool((changes[:, 2] >= 0).all()), "progress.q holds a negative number of steps")
    _check_states(changes[:, 0], 0, dfa_states)
    _check_states(changes[:, 1], -1, dfa_states)
    starts_q = arrays.get("starts.q", np.empty(0, np.int32))
    states = arrays.get("starts.state", np.empty((0, 0)))
    _check(starts_q.ndim == 1 and states.ndim == 2, "starts.q must be [m] and starts.state [m, s]")
    _check(len(states) <= MOST_STARTS, f"starts.state holds {len(states)} states; at most {MOST_STARTS} are allowed")
    size = states[:1].nbytes
    _check(size <= STARTS_BYTES, f"starts.state holds states of {size} bytes; at most {STARTS_BYTES} are allowed")
    _check(len(starts_q) == len(states), "starts.q and starts.state differ in length")
    _check_states(starts_q, 0, dfa_states)
    if len(states) and snapshot is not None:
        alike = states.dtype == snapshot.dtype and states.shape[1:] == snapshot.shape
        _check(alike, f"starts.state holds {states.dtype} {states.shape[1:]}, before {snapshot.dtype} {snapshot.shape}")
    rows = zip(changes.tolist(), rewards.tolist(), strict=True)
    return ReceivedProgress(
        [(q, q_next, steps, reward) for (q, q_next, steps), reward in rows],
        list(zip(starts_q.tolist(), states, strict=True)),
    )


def _check(holds: bool, text: str) -> None:
    if not holds:
        raise ProtocolError(f"sync: {text}")


def _check_states(states: NDArray[Any], lowest: int, count: int) -> None:
    _check(
        states.dtype.kind == "i" and bool(((states >= lowest) & (states < count)).all()),
        f"a DFA state is outside {lowest}..{count - 1}",
    )


def stack_starts(starts: Sequence[tuple[int, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Arrays ``starts.q`` [m] and ``starts.state`` [m, s]; nothing for no starts."""
    if not starts:
        return {}
    return {
        "starts.q": np.array([q for q, _ in starts], np.int32),
        "starts.state": np.stack([state for _, state in starts]),
    }
