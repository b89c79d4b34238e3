"""What holds in the coordinator whatever workers do and in whatever order."""

from __future__ import annotations

from dataclasses import dataclass

from coordinator_events import Conversation, changes, starts, weights
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from coordinator.events import Finish, RecordEvaluation, Send
from coordinator.snapshot import dashboard_state, summary
from t4nmtd_dist.wire.codec import Envelope, decode, encode
from t4nmtd_dist.wire.messages import (
    EvaluationJob,
    EvaluationPoll,
    EvaluationReport,
    Granted,
    LearnerStats,
    Refused,
    Release,
    SyncReply,
)

LEASE_S = 10.0
WORKERS = ("a", "b", "c")
PIDS = ("g", "p1", "p2", "p3")

workers = st.sampled_from(WORKERS)
pids = st.sampled_from(PIDS)


@dataclass
class Held:
    """What a worker believes to hold: its lease, and how far it has counted under it."""

    epoch: int
    sequence: int = 0
    interactions: int = 0
    cursor: int = 0
    version: int = 0


class AnyConversation(RuleBasedStateMachine):
    """Workers that claim, learn, repeat themselves, fall silent, come back late, and are evaluated."""

    @initialize()
    def begin(self) -> None:
        self.talk = Conversation("evaluation.every=10", lease_s=LEASE_S, max_interactions=2000)
        self.held: dict[tuple[str, str], Held] = {}
        self.epochs = dict.fromkeys(PIDS, 0)
        self.interactions = self.evaluated = self.finished = 0
        self.received: dict[tuple[str, int, str], set[int]] = {}

    def note(self, actions: list[object]) -> None:
        self.finished += sum(isinstance(action, Finish) for action in actions)
        self.evaluated += sum(isinstance(action, RecordEvaluation) for action in actions)
        for action in actions:
            if isinstance(action, Send):
                frames = encode(Envelope(action.message, action.arrays))
                assert encode(decode(frames)) == frames

    @rule(seconds=st.sampled_from([0.1, 3.0, LEASE_S + 1]))
    def wait(self, seconds: float) -> None:
        self.talk.now += seconds
        self.note(list(self.talk.tick()))

    @rule(worker=workers, pid=pids | st.none())
    def claim(self, worker: str, pid: str | None) -> None:
        live = {place for place in PIDS if self.talk.state.leases.live(place, self.talk.now)}
        holders = {place: self.talk.state.leases.get(place) for place in live}
        actions = self.talk.send(worker, self.talk.claim_message(pid, worker))
        self.note(list(actions))
        for action in actions:
            message = action.message if isinstance(action, Send) else None
            if isinstance(message, Granted):
                holder = holders.get(message.pid)
                assert holder is None or holder.instance == worker, "a live lease was given away"
                assert message.epoch > self.epochs[message.pid]
                self.epochs[message.pid] = message.epoch
                self.held[worker, message.pid] = Held(message.epoch)

    @rule(
        worker=workers,
        pid=pids,
        steps=st.integers(0, 50),
        row=st.tuples(st.integers(0, 4), st.integers(-1, 5)),
        start=st.tuples(st.integers(0, 5), st.integers(0, 30)),
        repeat=st.booleans(),
    )
    def sync(
        self, worker: str, pid: str, steps: int, row: tuple[int, int], start: tuple[int, int], repeat: bool
    ) -> None:
        held = self.held.get((worker, pid), Held(epoch=1))
        held.sequence += not repeat
        held.interactions += steps
        held.version += 1
        stats = LearnerStats(phase="training", interactions=held.interactions)
        message = self.talk.sync_message(
            pid,
            worker,
            sequence=held.sequence,
            epoch=held.epoch,
            version=held.version,
            cursor=held.cursor,
            stats=stats,
        )
        arrays = changes((*row, 1, 5.0)) | starts(start) | weights()
        actions = self.talk.send(worker, message, arrays)
        self.note(list(actions))
        for action in actions:
            if not isinstance(action, Send):
                continue
            if isinstance(action.message, SyncReply):
                assert self.holds(worker, pid, held)
                held.cursor = action.message.start_cursor
                assert pid not in action.message.peers
            elif isinstance(action.message, Refused):
                assert not self.holds(worker, pid, held)

    def holds(self, worker: str, pid: str, held: Held) -> bool:
        lease = self.talk.state.leases.get(pid)
        return lease is not None and lease.holder == worker.encode() and lease.epoch == held.epoch

    @rule(worker=workers, pid=pids)
    def release(self, worker: str, pid: str) -> None:
        held = self.held.get((worker, pid), Held(epoch=1))
        self.note(list(self.talk.send(worker, Release(pid=pid, epoch=held.epoch))))

    @precondition(lambda self: self.talk.state.outcome is None)
    @rule(success=st.sampled_from([0.5, 1.0]))
    def evaluate(self, success: float) -> None:
        epoch = self.talk.claim_evaluator("e").epoch
        job = self.talk.answer("e", EvaluationPoll(epoch=epoch))
        assert isinstance(job, EvaluationJob)
        if not job.job:
            return
        report = EvaluationReport(
            epoch=epoch,
            job=job.job,
            success_rate=success,
            mean_length=1.0,
            std_length=0.0,
            mean_return=0.0,
            episodes=1,
            dfa_path=[0],
        )
        self.note(list(self.talk.send("e", report)))

    @invariant()
    def interactions_never_decrease(self) -> None:
        assert self.talk.state.interactions >= self.interactions
        self.interactions = self.talk.state.interactions

    @invariant()
    def epochs_only_grow_and_one_holder_per_pid(self) -> None:
        for lease in self.talk.state.leases.all():
            assert lease.epoch == self.epochs[lease.place]
        places = [lease.place for lease in self.talk.state.leases.holders(self.talk.now)]
        assert len(places) == len(set(places))

    @invariant()
    def buffers_hold_what_can_be_gone_on_from(self) -> None:
        task = self.talk.state.task
        for pid, record in self.talk.state.records.items():
            for q in record.buffer.states_present():
                assert q not in task.terminal
                assert pid in task.decomposition.available(q)

    @invariant()
    def the_run_ends_at_most_once_and_for_a_reason(self) -> None:
        state = self.talk.state
        assert self.finished == (state.outcome is not None)
        assert (state.interactions >= 2000 or state.evaluations.solved) == (state.outcome is not None)
        assert self.evaluated == len(state.evaluations.history)

    @invariant()
    def the_state_can_always_be_published_and_summed_up(self) -> None:
        shown = dashboard_state(self.talk.state)
        assert decode(encode(Envelope(shown))).message == shown
        assert sum(row.total.interactions for row in shown.learners) == shown.interactions
        assert summary(self.talk.state)["interactions_total"] == shown.interactions


TestAnyConversation = AnyConversation.TestCase
TestAnyConversation.settings = settings(max_examples=25, stateful_step_count=30, deadline=None)
