"""Which leases to renew, and when; pure, with time as an argument."""

from __future__ import annotations

from dataclasses import dataclass

from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.fields import LARGEST_COUNT
from t4nmtd_dist.wire.messages import (
    EvaluationJob,
    EvaluationPoll,
    EvaluationReport,
    Granted,
    LearnerStats,
    Message,
    Refused,
    Release,
    Sync,
    SyncReply,
)

RENEWAL = 16  # added to a renewal's number, to recognise its reply
RENEWALS_PER_LEASE = 4


@dataclass
class _Lease:
    """A lease under which the loop has reported.

    Attributes:
        renewed: time of its last report or renewal.
    """

    epoch: int
    renewed: float


class LeaseRenewals:
    """Renews leases that the learner loop has reported under, until released or refused.

    Attributes:
        lease_s: seconds for which one message keeps a lease.
    """

    def __init__(self) -> None:
        self.lease_s = float("inf")
        self._learners: dict[str, _Lease] = {}
        self._evaluators: dict[int, _Lease] = {}  # by message number: own work, or as a stand-in

    @property
    def interval_s(self) -> float:
        """Seconds between renewals of a lease."""
        return self.lease_s / RENEWALS_PER_LEASE

    def sent(self, envelope: Envelope, now: float) -> None:
        """Process an outgoing message: a report renews its lease, a release ends it."""
        message = envelope.message
        if isinstance(message, Sync):
            self._learners[message.pid] = _Lease(message.epoch, now)
        elif isinstance(message, EvaluationPoll | EvaluationReport):
            self._evaluators[envelope.id] = _Lease(message.epoch, now)
        elif isinstance(message, Release) and message.pid in self._learners:
            self.forget(message.pid)
        elif isinstance(message, Release):
            self._evaluators.pop(envelope.id, None)

    def forget(self, pid: str) -> None:
        """Stop renewing a sub-task's lease."""
        self._learners.pop(pid, None)

    def due(self, now: float) -> list[Envelope]:
        """Renewal messages for leases that were not renewed for an interval."""
        found: list[Envelope] = []
        for pid, lease in self._learners.items():
            if self._is_due(lease, now):
                found.append(Envelope(_sign_of_life(pid, lease.epoch), id=RENEWAL))
        for number, lease in self._evaluators.items():
            if self._is_due(lease, now):
                found.append(Envelope(EvaluationPoll(epoch=lease.epoch, busy=True), id=RENEWAL + number))
        return found

    def _is_due(self, lease: _Lease, now: float) -> bool:
        if now < lease.renewed + self.interval_s:
            return False
        lease.renewed = now
        return True

    def received(self, envelope: Envelope) -> tuple[Envelope, bool]:
        """Process an incoming message; returns it for the loop, and whether it only answers a renewal."""
        message, renewal = envelope.message, envelope.id >= RENEWAL
        if isinstance(message, Granted):
            self.lease_s = message.lease_s
        elif isinstance(message, Refused) and message.reason == "stale epoch":
            self._refused(message, envelope.id % RENEWAL)
        for_loop = Envelope(message, envelope.arrays, envelope.sender, envelope.id % RENEWAL)
        return for_loop, renewal and isinstance(message, SyncReply | EvaluationJob)

    def _refused(self, refused: Refused, number: int) -> None:
        """Stop renewing a refused lease."""
        if refused.pid in self._learners:
            self.forget(refused.pid or "")
        else:
            self._evaluators.pop(number, None)


def _sign_of_life(pid: str, epoch: int) -> Message:
    """A heartbeat: no progress (sequence 0), no start states (largest cursor)."""
    return Sync(pid=pid, epoch=epoch, sequence=0, version=0, start_cursor=LARGEST_COUNT, stats=LearnerStats())
