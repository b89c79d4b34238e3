"""Claims, grants and ends of leases on sub-tasks and the evaluator role."""

from __future__ import annotations

from collections.abc import Mapping, Set

from coordinator.event_log import EventLog, RunClock
from coordinator.events import Action, Received, Send
from coordinator.learner_registry import LearnerRecord
from coordinator.leases import Lease, LeaseTable
from coordinator.numbering import numbered
from coordinator.refusals import live_lease, stale_learner, unknown_pid
from coordinator.run_settings import RunSettings
from coordinator.stand_ins import StandIns
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.wire.codec import with_prefix
from t4nmtd_dist.wire.messages import Claim, Granted, Peer, Refused, Release, Sync

EVALUATOR = "evaluator"


class Leasing:
    """Decides which worker trains each sub-task, and which evaluates.

    Attributes:
        learners: leases on the sub-tasks.
        evaluator: the lease on the evaluator role.
        stand_ins: the learners' workers that hold the evaluator role.
    """

    def __init__(
        self,
        task: CompiledTask,
        settings: RunSettings,
        records: Mapping[str, LearnerRecord],
        clock: RunClock,
        log: EventLog,
    ) -> None:
        self._task, self._settings, self._records, self._clock, self._log = task, settings, records, clock, log
        pids = task.decomposition.pids
        self._pid_by_number = numbered(pids)
        self.learners = LeaseTable(pids, settings.lease_s)
        self.evaluator = LeaseTable([EVALUATOR], settings.lease_s)
        self.stand_ins = StandIns(self.evaluator)

    def claim(self, event: Received, claim: Claim) -> list[Action]:
        """Grant a lease, or refuse it with the reason."""
        peer, now = event.peer, self._clock.now
        table = self.evaluator if claim.role == "evaluator" else self.learners
        place = self._place(event, claim, table)
        if place is None:
            text = "every sub-task has a learner; standing by"
            return [_answer(event, Refused(reason="nothing free", text=text, final=False))]
        if place not in table.places:
            return [_answer(event, unknown_pid(self._task.config.name, place, table.places))]
        stands_in = table is self.evaluator and claim.stand_in
        if table is self.evaluator and not stands_in:
            self.stand_ins.yield_to_evaluator()
        before = table.get(place)
        instance = f"{claim.instance} between its turns" if stands_in else claim.instance
        lease = table.claim(place, peer, instance, claim.critic_endpoint, now, event.key)
        if lease is None:
            return [_answer(event, live_lease(claim, place, before, now))]
        return self._grant(event, claim, lease)

    def _place(self, event: Received, claim: Claim, table: LeaseTable) -> str | None:
        """The claimed sub-task by name or number, the one held before, or a free one."""
        if claim.role == "evaluator":
            return EVALUATOR
        if claim.pid is not None:
            return self._pid_by_number.get(claim.pid, claim.pid)
        held = table.held_before_by(claim.instance, event.key, event.peer, self._clock.now)
        return held or table.next_free(self._clock.now)

    def _grant(self, event: Received, claim: Claim, lease: Lease) -> list[Action]:
        record = self._records.get(lease.place)
        if record is not None:
            record.begin_epoch()
        weights = with_prefix("weights.", record.weights) if record else {}
        granted = Send(event.peer, self._granted(claim, lease, record), weights, event.envelope.id)
        text = f"{claim.instance} takes {lease.place} (epoch {lease.epoch})"
        if record is None and claim.stand_in:
            text = self.stand_ins.begin(lease)
        return [granted, *([self._log.add(text)] if text else [])]

    def _granted(self, claim: Claim, lease: Lease, record: LearnerRecord | None) -> Granted:
        return Granted(
            role=claim.role,
            pid=lease.place,
            epoch=lease.epoch,
            lease_s=self._settings.lease_s,
            seed=self._settings.seed,
            task=self._task.config.to_dict(),
            dfa=self._task.dfa.to_json(),
            decomposition=self._task.decomposition.to_json(),
            rho=[float(x) for x in self._task.rho],
            version=record.version if record else 0,
            run_id=self._settings.run_id,
            asked=claim.pid or "",
        )

    def release(self, peer: bytes, release: Release) -> list[Action]:
        """Process a holder's release of its lease."""
        if self.stand_ins.release(release.pid, release.epoch, peer):
            return []
        tables = (self.learners, self.evaluator)
        if not any(table.release(release.pid, release.epoch, peer) for table in tables):
            return []
        return [self._log.add(f"{release.pid} given back")]

    def end_revoked(self, allowed: Set[str]) -> list[Action]:
        """End the leases of clients whose key is no longer ``allowed``."""
        logged: list[Action] = []
        for table in (self.learners, self.evaluator):
            for lease in table.holders(self._clock.now):
                if lease.key and lease.key not in allowed:
                    table.end(lease.place)
                    logged.append(self._log.add(f"{lease.place} taken from {lease.instance}: its key was revoked"))
        return logged

    def report_lost(self) -> list[Action]:
        """Log each learner whose lease has expired, once."""
        logged: list[Action] = []
        for lease in self.learners.all():
            record = self._records[lease.place]
            if lease.expires <= self._clock.now and not lease.released and not record.lost:
                record.lost = True
                silent_s = self._clock.now - lease.heard
                logged.append(self._log.add(f"{lease.place} lost: {lease.instance} silent for {silent_s:.0f} s"))
        return logged

    def renew(self, peer: bytes, sync: Sync) -> bool:
        """Renew a learner's lease; False if it holds none."""
        return self.learners.renew(sync.pid, sync.epoch, peer, self._clock.now)

    def report_back(self, pid: str) -> list[Action]:
        """Log the return of a lost learner."""
        record = self._records[pid]
        was_lost, record.lost = record.lost, False
        return [self._log.add(f"{pid} heard again")] if was_lost else []

    def refuse_stale(self, event: Received, sync: Sync) -> list[Action]:
        """Answer a learner whose lease is not, or no longer, its own."""
        lease = self.learners.get(sync.pid) if sync.pid in self.learners.places else None
        if lease is not None and lease.holder == event.peer and sync.epoch < lease.epoch:
            return []  # sent before the grant of the newer epoch arrived there
        return [_answer(event, stale_learner(sync, lease))]

    def peers_of(self, pid: str) -> dict[str, Peer]:
        """The critic endpoints of all other learners with live leases."""
        return {
            lease.place: Peer(
                endpoint=lease.endpoint,
                version=self._records[lease.place].version,
                epoch=lease.epoch,
                key=lease.key,
            )
            for lease in self.learners.holders(self._clock.now)
            if lease.place != pid and lease.endpoint
        }


def _answer(event: Received, refused: Refused) -> Send:
    return Send(event.peer, refused, answers=event.envelope.id)
