"""The coordinator as a pure state machine (paper, Algorithm 1): events in, actions out; no sockets, no clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Set
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coordinator.bulletin import Bulletin
from coordinator.checks import check_report, finite_figures
from coordinator.evaluations import EvaluationSchedule
from coordinator.events import (
    Action,
    Event,
    Finish,
    Interrupted,
    KeysChanged,
    Noticed,
    Outcome,
    Received,
    RecordEvaluation,
    Send,
    Tell,
)
from coordinator.intake import Intake, usable
from coordinator.learner_registry import LearnerRecord
from coordinator.leases import Lease, LeaseTable
from coordinator.numbering import numbered
from coordinator.refusals import live_lease, stale_evaluator, unknown_pid
from coordinator.stand_ins import StandIns
from coordinator.stuck import StuckWatch
from t4nmtd_dist.agents.weights import acting_parameters
from t4nmtd_dist.core.errors import ProtocolError
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.method.start_states import InitialStateBuffer
from t4nmtd_dist.runs.report import solved_text
from t4nmtd_dist.wire.codec import with_prefix, without_prefix
from t4nmtd_dist.wire.limits import most_starts
from t4nmtd_dist.wire.messages import (
    Claim,
    EvaluationJob,
    EvaluationPoll,
    EvaluationReport,
    EventLine,
    Failure,
    Goodbye,
    Granted,
    Notice,
    Peer,
    Refused,
    Release,
    RunPhase,
    Sync,
    SyncReply,
)
from t4nmtd_dist.wire.progress import PackedProgress, pack_starts, unpack_progress

EVALUATOR = "evaluator"
STARTS_PER_REPLY = 256
EVENTS_KEPT = 50


@dataclass(frozen=True)
class RunSettings:
    """What a run adds to its task.

    Attributes:
        run_id: names the run, however often it is resumed, so that workers know which checkpoints are of it.
        lease_s: seconds of silence after which a worker counts as lost.
    """

    seed: int
    max_interactions: int
    run_dir: str = ""
    lease_s: float = 10.0
    run_id: str = ""


class CoordinatorState:
    """Owns the task, the Q table, the initial-state buffers, the leases, the newest weights and the counters.

    Args:
        task: the compiled task.
        settings: the run's own settings.

    Attributes:
        snapshot: a start state, if one has come: all of a run are alike in type and size.
        earlier_s: seconds that the run took before it was resumed.
    """

    def __init__(self, task: CompiledTask, settings: RunSettings) -> None:
        self.task, self.settings = task, settings
        self.method = task.method()
        self.rng = np.random.default_rng([settings.seed, 2])
        pids = task.decomposition.pids
        self.records = {pid: LearnerRecord(InitialStateBuffer()) for pid in pids}
        self.leases = LeaseTable(pids, settings.lease_s)
        self.numbers = numbered(pids)
        self.evaluator_lease = LeaseTable([EVALUATOR], settings.lease_s)
        self.stand_ins = StandIns(self.evaluator_lease)
        self.evaluations = EvaluationSchedule(task.config.evaluation)
        self.outcome: Outcome | None = None
        self.events: deque[EventLine] = deque(maxlen=EVENTS_KEPT)
        self.now = self.began = 0.0
        self._clock_started = False
        self._lost: set[str] = set()
        self._bulletin, self._stuck = Bulletin(), StuckWatch()
        self._intake = Intake(task)
        self._complained: set[str] = set()
        self._unusable: set[str] = set()
        self.snapshot: NDArray[Any] | None = None
        self.earlier_s = 0.0
        self._ended: float | None = None

    @property
    def elapsed_s(self) -> float:
        """Seconds from the first event to the end of the run, those before a resume included."""
        return self.earlier_s + (self.now if self._ended is None else self._ended) - self.began

    @property
    def interactions(self) -> int:
        """Environment steps of all learners together, evaluation excluded."""
        return sum(record.interactions for record in self.records.values())

    @property
    def learners_s(self) -> float:
        """Processor time of all learners."""
        return sum(record.total.processor_s for record in self.records.values())

    @property
    def phase(self) -> RunPhase:
        """Where the run stands."""
        if self.outcome is not None:
            return self.outcome
        return "training" if self.interactions else "starting"

    def handle(self, event: Event) -> list[Action]:
        """Take one event; the actions are to be carried out in order."""
        if not self._clock_started:
            self.began, self._clock_started = event.now, True
            self._ended = event.now if self.outcome is not None else None  # it was loaded
        self.now = event.now
        if isinstance(event, Received):
            return self._receive(event)
        if isinstance(event, Interrupted):
            return self._finish("stopped", event.reason)
        if isinstance(event, KeysChanged):
            return self._end_leases_without_key(event.allowed)
        if isinstance(event, Noticed):
            return [self._tell(event.text)]
        return self._notice_lost()

    def _receive(self, event: Received) -> list[Action]:
        peer, envelope = event.peer, event.envelope
        message = envelope.message
        try:
            if self.outcome is not None:
                return self._receive_late(event, self.outcome)
            if isinstance(message, Claim):
                return self._claim(event, message)
            if isinstance(message, Sync):
                return self._sync(event, message)
            if isinstance(message, Release):
                return self._release(peer, message)
            if isinstance(message, EvaluationPoll):
                return self._evaluation_poll(peer, message, envelope.id)
            if isinstance(message, EvaluationReport):
                return self._evaluation_report(peer, message)
            if isinstance(message, Notice):
                return [self._tell(line) for line in self._bulletin.lines(message.text)]
        except ProtocolError as error:
            return [Send(peer, Failure(text=str(error)), answers=envelope.id)]
        text = f"the coordinator does not take {type(message).__name__} messages"
        return [Send(peer, Failure(text=text), answers=envelope.id)]

    def _receive_late(self, event: Received, outcome: Outcome) -> list[Action]:
        """The run is over; what learners have done until they heard of it still counts."""
        message = event.envelope.message
        told: list[Action] = []
        if isinstance(message, Sync) and self.leases.renew(message.pid, message.epoch, event.peer, self.now):
            told = self._accept(message, event.envelope.arrays)
            told += [self._reply(event.peer, message, self.records[message.pid], event.envelope.id)]
        elif isinstance(message, Release):
            told = self._release(event.peer, message)
        return [*told, Send(event.peer, Goodbye(reason=outcome), answers=event.envelope.id)]

    # Leases

    def _claim(self, event: Received, claim: Claim) -> list[Action]:
        peer, answers = event.peer, event.envelope.id
        table = self.evaluator_lease if claim.role == "evaluator" else self.leases
        left = table.left_by(claim.instance, event.key, peer, self.now)
        asked = self.numbers.get(claim.pid or "", claim.pid)
        place = EVALUATOR if claim.role == "evaluator" else asked or left or table.next_free(self.now)
        if place is None:
            text = "every sub-task has a learner; standing by"
            return [Send(peer, Refused(reason="nothing free", text=text, final=False), answers=answers)]
        if place not in table.places:
            return [Send(peer, unknown_pid(self.task.config.name, place, table.places), answers=answers)]
        stands_in = table is self.evaluator_lease and claim.stand_in
        if table is self.evaluator_lease and not stands_in:
            self.stand_ins.give_way()
        before = table.get(place)
        instance = f"{claim.instance} between its turns" if stands_in else claim.instance
        lease = table.claim(place, peer, instance, claim.critic_endpoint, self.now, event.key)
        if lease is None:
            return [Send(peer, live_lease(claim, place, before, self.now), answers=answers)]
        return self._grant(peer, claim, lease, answers)

    def _grant(self, peer: bytes, claim: Claim, lease: Lease, answers: int) -> list[Action]:
        record = self.records.get(lease.place)
        if record is not None:
            record.begin_epoch()
            self._lost.discard(lease.place)
            self._complained.discard(lease.place)
            self._unusable.discard(lease.place)
        granted = Granted(
            role=claim.role,
            pid=lease.place,
            epoch=lease.epoch,
            lease_s=self.settings.lease_s,
            seed=self.settings.seed,
            task=self.task.config.to_dict(),
            dfa=self.task.dfa.to_json(),
            decomposition=self.task.decomposition.to_json(),
            rho=[float(x) for x in self.task.rho],
            version=record.version if record else 0,
            run_id=self.settings.run_id,
            asked=claim.pid or "",
        )
        arrays = with_prefix("weights.", record.weights) if record else {}
        text = f"{claim.instance} takes {lease.place} (epoch {lease.epoch})"
        if record is None and claim.stand_in:
            text = self.stand_ins.begin(lease)
        return [Send(peer, granted, arrays, answers), *([self._tell(text)] if text else [])]

    def _release(self, peer: bytes, release: Release) -> list[Action]:
        if self.stand_ins.release(release.pid, release.epoch, peer):
            return []
        tables = (self.leases, self.evaluator_lease)
        if not any(table.release(release.pid, release.epoch, peer) for table in tables):
            return []
        return [self._tell(f"{release.pid} given back")]

    def _end_leases_without_key(self, allowed: Set[str]) -> list[Action]:
        told: list[Action] = []
        for table in (self.leases, self.evaluator_lease):
            for lease in table.holders(self.now):
                if lease.key and lease.key not in allowed:
                    table.end(lease.place)
                    told.append(self._tell(f"{lease.place} taken from {lease.instance}: its key was revoked"))
        return told

    def _notice_lost(self) -> list[Action]:
        told: list[Action] = []
        for lease in self.leases.all():
            if lease.expires <= self.now and not lease.released and lease.place not in self._lost:
                self._lost.add(lease.place)
                silent = self.now - lease.heard
                told.append(self._tell(f"{lease.place} lost: {lease.instance} silent for {silent:.0f} s"))
        return told

    # Learners

    def _sync(self, event: Received, sync: Sync) -> list[Action]:
        peer, answers = event.peer, event.envelope.id
        if not self.leases.renew(sync.pid, sync.epoch, peer, self.now):
            return self._refuse_stale(peer, sync, answers)
        told = self._accept(sync, event.envelope.arrays)
        back: list[Action] = [self._tell(f"{sync.pid} heard again")] if sync.pid in self._lost else []
        self._lost.discard(sync.pid)
        news = self._stuck.news(sync.pid, self.records, self.task, self.elapsed_s)
        back += [self._tell(line) for line in news]
        reply = self._reply(peer, sync, self.records[sync.pid], answers)
        if self.interactions >= self.settings.max_interactions:
            return [*told, *back, reply, *self._finish("budget spent", f"{self.interactions} interactions")]
        return [*told, *back, reply]

    def _accept(self, sync: Sync, arrays: Mapping[str, NDArray[Any]]) -> list[Action]:
        """Take in what is new: progress, counts and weights; lines about what is of no use."""
        progress = unpack_progress(arrays, self.task.dfa.states, self.snapshot)
        record = self.records[sync.pid]
        told: list[Action] = []
        if sync.sequence > record.sequence:
            record.sequence = sync.sequence
            told += self._apply(sync.pid, progress)
            record.update(finite_figures(sync.stats), self.now)
        weights = without_prefix("weights.", arrays)
        if not weights or sync.version <= record.version:
            return told
        trouble = self._intake.weights_trouble(weights, sync.version, self.records.values())
        if trouble:
            self._unusable.add(sync.pid)
        else:
            self._unusable.discard(sync.pid)
            record.version, record.weights = sync.version, weights
        return told + self._complain(sync.pid, trouble)

    def _complain(self, pid: str, trouble: str) -> list[Action]:
        """Tell of trouble with a learner, once for each of its leases."""
        if not trouble or pid in self._complained:
            return []
        self._complained.add(pid)
        return [self._tell(f"{pid}: {trouble}")]

    def _refuse_stale(self, peer: bytes, sync: Sync, answers: int) -> list[Action]:
        lease = self.leases.get(sync.pid) if sync.pid in self.leases.places else None
        if lease is None:
            text = f"no lease on {sync.pid!r} is known here (the coordinator was started again); claim it again"
        elif lease.holder == peer and sync.epoch < lease.epoch:
            return []  # sent before the grant of the newer epoch, which is on its way, arrived there
        else:
            text = f"epoch {sync.epoch} of {sync.pid} is over: {lease.instance} holds epoch {lease.epoch}"
        final = lease is not None and sync.epoch != lease.epoch  # the same epoch: the same learner, connected anew
        refused = Refused(reason="stale epoch", text=text, final=final, pid=sync.pid)
        return [Send(peer, refused, answers=answers)]

    def _apply(self, pid: str, progress: PackedProgress) -> list[Action]:
        self.method.told(pid, progress.changes)
        starts = usable(progress.starts)
        for q, state in starts:
            self.snapshot = state
            if q in self.task.terminal:
                continue
            for receiver in self.method.receivers(pid, q, self.rng):
                self.records[receiver].buffer.add(q, state)
        dropped = len(progress.starts) - len(starts)
        return self._complain(pid, f"{dropped} start states are dropped: they are not finite" if dropped else "")

    def _reply(self, peer: bytes, sync: Sync, record: LearnerRecord, answers: int) -> Send:
        size = 1 if self.snapshot is None else self.snapshot.nbytes
        fresh = record.buffer.since(sync.start_cursor, most_starts(STARTS_PER_REPLY, size))
        reply = SyncReply(
            pid=sync.pid,
            epoch=sync.epoch,
            accepted_sequence=record.sequence,
            start_cursor=fresh[-1][0] if fresh else sync.start_cursor,
            q_table=self.method.entries(),
            peers=self._peers(sync.pid),
            evaluate=self.interactions > 0 and self.stand_ins.wanted(self.now) and self._evaluation_due(),
        )
        return Send(peer, reply, pack_starts([(q, state) for _, q, state in fresh]), answers)

    def _peers(self, pid: str) -> dict[str, Peer]:
        return {
            lease.place: Peer(
                endpoint=lease.endpoint,
                version=self.records[lease.place].version,
                epoch=lease.epoch,
                key=lease.key,
            )
            for lease in self.leases.holders(self.now)
            if lease.place != pid and lease.endpoint
        }

    # Evaluations

    def _evaluation_poll(self, peer: bytes, poll: EvaluationPoll, answers: int) -> list[Action]:
        if not self.evaluator_lease.renew(EVALUATOR, poll.epoch, peer, self.now):
            return [Send(peer, stale_evaluator(EVALUATOR), answers=answers)]
        if poll.busy or not self._evaluation_due():
            return [Send(peer, EvaluationJob(job=0), answers=answers)]
        versions = self._versions()
        weights = {pid: acting_parameters(self.records[pid].weights) for pid in versions}
        snapshot = self.evaluations.hand_out(self.interactions, self.method.entries(), versions, weights)
        job = EvaluationJob(
            job=snapshot.job,
            interactions=snapshot.interactions,
            q_table=snapshot.q_table,
            versions=snapshot.versions,
            actions=self.evaluations.modes,
        )
        arrays = {f"{pid}/weights.{name}": array for pid, named in weights.items() for name, array in named.items()}
        return [Send(peer, job, arrays, answers)]

    def _versions(self) -> dict[str, int]:
        return {pid: record.version for pid, record in self.records.items() if record.version}

    def _evaluation_due(self) -> bool:
        return self.evaluations.due(self.interactions, self._versions(), self._training(), self.learners_s)

    def _training(self) -> frozenset[str]:
        """Whose newer weights an evaluation waits for: unusable ones will never come."""
        return frozenset(
            pid
            for pid, record in self.records.items()
            if record.current.phase == "training" and pid not in self._unusable and self.leases.live(pid, self.now)
        )

    def _evaluation_report(self, peer: bytes, report: EvaluationReport) -> list[Action]:
        if not self.evaluator_lease.renew(EVALUATOR, report.epoch, peer, self.now):
            return []
        check_report(report, self.task)
        row = self.evaluations.report(report, self.elapsed_s)
        if row is None:
            return []
        told: list[Action] = [RecordEvaluation(row)]
        if self.evaluations.solved:
            first, needed = self.evaluations.solved_at or 0, self.evaluations.config.in_a_row
            reason = solved_text(first, self.interactions, needed).removeprefix("solved ")
            return told + self._finish("solved", reason)
        return told

    # The end

    def _finish(self, outcome: Outcome, reason: str) -> list[Action]:
        if self.outcome is not None:
            return []
        self.outcome, self._ended = outcome, self.now
        leases = self.leases.holders(self.now) + self.evaluator_lease.holders(self.now)
        peers = sorted({lease.holder for lease in leases})
        told = self._tell(f"{outcome}: {reason}")
        return [told, *(Send(peer, Goodbye(reason=outcome)) for peer in peers), Finish(outcome, reason)]

    def _tell(self, text: str) -> Tell:
        self.events.append(EventLine(elapsed_s=self.elapsed_s, text=text))
        return Tell(self.elapsed_s, text)
