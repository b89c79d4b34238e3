"""Lets learners' workers stand in for a missing evaluator."""

from __future__ import annotations

from coordinator.leases import Lease, LeaseTable

STAND_IN_AFTER_S = 10.0


class StandIns:
    """Learners' workers that evaluate between their turns.

    They are invited after ``STAND_IN_AFTER_S`` seconds without an evaluator, so that one has time to start or restart.

    Args:
        table: the leases on the evaluator role.

    Attributes:
        epoch: of the newest stand-in's lease; 0 before the first.
    """

    def __init__(self, table: LeaseTable) -> None:
        self._table = table
        (self._place,) = table.places
        self.epoch = 0
        self._alone_since: float | None = None
        self._logged = False

    def evaluator(self, now: float) -> Lease | None:
        """The live lease of a proper evaluator."""
        lease = self._table.get(self._place)
        return None if lease is None or lease.expires <= now or self._is_stand_in(lease) else lease

    def wanted(self, now: float) -> bool:
        """Whether to invite a stand-in now; call on every learner's heartbeat."""
        if self.evaluator(now) is not None:
            self._alone_since, self._logged = None, False
            return False
        if self._alone_since is None:
            self._alone_since = now
        return not self._table.live(self._place, now) and now - self._alone_since >= STAND_IN_AFTER_S

    def begin(self, lease: Lease) -> str:
        """Register a stand-in's lease; returns a line to log for the first, else ""."""
        self.epoch = lease.epoch
        logged, self._logged = self._logged, True
        return "" if logged else "no evaluator: the learners' workers evaluate between their turns"

    def yield_to_evaluator(self) -> None:
        """End a stand-in's lease because an evaluator claims the role."""
        if self._is_stand_in(self._table.get(self._place)):
            self._table.end(self._place)

    def release(self, place: str, epoch: int, holder: bytes) -> bool:
        """Release a stand-in's lease; False if it was not one."""
        lease = self._table.get(self._place)
        return place == self._place and self._is_stand_in(lease) and self._table.release(place, epoch, holder)

    def _is_stand_in(self, lease: Lease | None) -> bool:
        return lease is not None and lease.epoch == self.epoch
