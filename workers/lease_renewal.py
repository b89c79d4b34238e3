"""Which leases to renew, and when: pure, with the time as an argument."""

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

RENEWAL = 16  # added to the number of a renewal, by which answers to it are known
RENEWALS_PER_LEASE = 4


@dataclass
class _Lease:
    """A lease under which the loop has reported.

    Attributes:
        epoch: of the lease.
        renewed: when the loop last reported under it, or it was last renewed.
    """

    epoch: int
    renewed: float


class LeaseRenewals:
    """Renews every lease under which the learner loop has reported, until the loop releases it or it is refused.

    Attributes:
        lease_s: seconds for which one message keeps a lease.
    """

    def __init__(self) -> None:
        self.lease_s = float("inf")
        self._learners: dict[str, _Lease] = {}
        self._evaluators: dict[int, _Lease] = {}  # by the number of the loop's messages: own work, or as a stand-in

    @property
    def interval_s(self) -> float:
        """Seconds between two messages under a lease."""
        return self.lease_s / RENEWALS_PER_LEASE

    def sent(self, envelope: Envelope, now: float) -> None:
        """The loop sends a message: a report renews a lease, and a release ends it."""
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
        """The loop does not learn a sub-task any more."""
        self._learners.pop(pid, None)

    def due(self, now: float) -> list[Envelope]:
        """The messages that renew what has not been renewed for an interval."""
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
        """A message has come: as the loop is to see it, and whether it is nothing but the answer to a renewal."""
        message, renewal = envelope.message, envelope.id >= RENEWAL
        if isinstance(message, Granted):
            self.lease_s = message.lease_s
        elif isinstance(message, Refused) and message.reason == "stale epoch":
            self._refused(message, envelope.id % RENEWAL)
        for_loop = Envelope(message, envelope.arrays, envelope.sender, envelope.id % RENEWAL)
        return for_loop, renewal and isinstance(message, SyncReply | EvaluationJob)

    def _refused(self, refused: Refused, number: int) -> None:
        """Renew a lease no longer that was refused: the loop decides what follows."""
        if refused.pid in self._learners:
            self.forget(refused.pid or "")
        else:
            self._evaluators.pop(number, None)


def _sign_of_life(pid: str, epoch: int) -> Message:
    """Sequence 0 carries no progress, and no start state is newer than the largest cursor."""
    return Sync(pid=pid, epoch=epoch, sequence=0, version=0, start_cursor=LARGEST_COUNT, stats=LearnerStats())
