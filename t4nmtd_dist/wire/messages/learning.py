"""Messages that learners and the coordinator exchange several times a second."""

from __future__ import annotations

from t4nmtd_dist.wire.fields import Count, Name
from t4nmtd_dist.wire.messages.base import Message
from t4nmtd_dist.wire.messages.statistics import LearnerStats


class Sync(Message, frozen=True, tag="sync"):
    """Learner -> coordinator, several times a second: heartbeat, progress, weights.

    ``sequence`` numbers the batch of progress; repeats are ignored, and 0 is a heartbeat without progress.
    ``start_cursor`` is the newest start state the learner holds. arrays: ``progress.q`` int32 [n, 3] (q, q' or -1,
    steps), ``progress.reward`` float64 [n], ``starts.q`` int32 [m], ``starts.state`` [m, s], and ``weights.*`` if
    ``version`` is newer than the last one sent.
    """

    pid: Name
    epoch: Count
    sequence: Count
    version: Count
    start_cursor: Count
    stats: LearnerStats


class Peer(Message, frozen=True):
    """A peer's critic endpoint, and the newest version of its weights known to the coordinator.

    ``key`` is the peer's public key; empty if the coordinator has no keys.
    """

    endpoint: str
    version: int
    epoch: int
    key: str = ""


class SyncReply(Message, frozen=True, tag="sync_reply"):
    """Coordinator -> learner. arrays: ``starts.q`` int32 [m] and ``starts.state`` [m, s], the new start states.

    ``evaluate``: an evaluation is due without an evaluator, so this learner's worker may stand in.
    """

    pid: str
    epoch: int
    accepted_sequence: int
    start_cursor: int
    q_table: list[tuple[int, str, float]]
    peers: dict[str, Peer]
    evaluate: bool = False
