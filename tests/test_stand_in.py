"""Without an evaluator the learners' workers evaluate between their turns, for a tenth of their time at most."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import pytest
from coordinator_events import Conversation, of, weights
from hypothesis import given, settings
from hypothesis import strategies as st
from small_tasks import small_task

from coordinator.events import LogEvent, Received, RecordEvaluation, Send
from coordinator.stand_ins import STAND_IN_AFTER_S
from t4nmtd_dist.agents.registry import build_learner
from t4nmtd_dist.agents.weights import acting_parameters
from t4nmtd_dist.core.errors import PolicyError
from t4nmtd_dist.method.start_states import InitialStateBuffer
from t4nmtd_dist.policy.evaluation import Evaluator
from t4nmtd_dist.policy.global_policy import GlobalPolicy
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import (
    Claim,
    EvaluationJob,
    EvaluationPoll,
    EvaluationReport,
    Granted,
    LearnerStats,
    Message,
    Refused,
    Release,
)
from workers.evaluation_work import SLICE_S, EvaluationWork
from workers.stand_in import STAND_IN, TIME_SHARE, SpareTime, StandIn
from workers.state import Exit, WorkerState

JUST_BEFORE, AFTER = STAND_IN_AFTER_S - 0.1, STAND_IN_AFTER_S + 0.1


class Alone(Conversation):
    """Learners of task 7 without an evaluator; an evaluation is due whenever one has trained."""

    def __init__(self, lease_s: float = 10.0) -> None:
        super().__init__("evaluation.every=1", lease_s=lease_s)
        self.sequence = 0
        for pid in ("p1", "p2"):
            self.claim(pid, pid)

    def train(self, worker: str = "p1") -> bool:
        """Both learners train and are heard; whether this one's worker is invited to evaluate."""
        self.sequence += 1
        replies = {}
        for pid in ("p1", "p2"):
            stats = LearnerStats(phase="training", interactions=self.sequence, processor_s=100.0 * self.sequence)
            arrays = weights(self.sequence)
            message = self.sync_message(pid, pid, sequence=self.sequence, version=self.sequence, stats=stats)
            replies[pid] = self.answers(pid, message, arrays)[0].message
        return bool(replies[worker].evaluate)  # type: ignore[attr-defined]

    def stand_in(self, worker: str) -> Granted | Refused:
        answer = self.answer(worker, Claim(role="evaluator", instance=worker, stand_in=True))
        assert isinstance(answer, Granted | Refused)
        return answer

    def poll(self, worker: str, epoch: int, *, busy: bool = False) -> list[Message]:
        return [sent.message for sent in self.answers(worker, EvaluationPoll(epoch=epoch, busy=busy))]

    def report(self, worker: str, epoch: int, job: int) -> list[RecordEvaluation]:
        return of(RecordEvaluation, self.send(worker, report_of(job, epoch)))


def report_of(job: int, epoch: int = 1) -> EvaluationReport:
    return EvaluationReport(
        epoch=epoch,
        job=job,
        success_rate=0.0,
        mean_length=1.0,
        std_length=0.0,
        mean_return=0.0,
        episodes=1,
        dfa_path=[0],
    )


def granted_epoch(answer: Granted | Refused) -> int:
    assert isinstance(answer, Granted), answer
    return answer.epoch


def test_learners_are_invited_some_time_after_the_first_interactions() -> None:
    talk = Alone()
    talk.now = 100.0
    assert not talk.train()
    talk.now += JUST_BEFORE
    assert not talk.train()
    talk.now += 0.2
    assert talk.train()


def test_nobody_is_invited_while_an_evaluator_is_heard_and_for_some_time_after() -> None:
    talk = Alone()
    talk.train()
    epoch = talk.claim_evaluator("e").epoch
    for _ in range(30):
        talk.now += 1.0
        assert not talk.train()
        assert talk.poll("e", epoch, busy=True) == [EvaluationJob(job=0)]
    lease = talk.state.evaluator_lease.get("evaluator")
    assert lease is not None
    talk.now = lease.expires + 0.1
    assert not talk.train()
    talk.now += JUST_BEFORE
    assert not talk.train(), "one that is started again after a crash comes within this time"
    talk.now += 0.2
    assert talk.train()


def test_a_busy_evaluator_keeps_its_place_and_gets_no_further_job() -> None:
    talk = Alone()
    talk.train()
    epoch = talk.claim_evaluator("e").epoch
    (job,) = talk.poll("e", epoch)
    assert isinstance(job, EvaluationJob)
    for _ in range(40):
        talk.now += 1.0
        assert not talk.train()
        assert talk.poll("e", epoch, busy=True) == [EvaluationJob(job=0)]
    assert len(talk.report("e", epoch, job.job)) == 1


def invited(talk: Alone) -> Alone:
    talk.train()
    talk.now += AFTER
    assert talk.train()
    return talk


def test_a_stand_in_evaluates_once_and_another_worker_may_be_next() -> None:
    talk = invited(Alone())
    epoch = granted_epoch(talk.stand_in("p1"))
    assert not talk.train("p2"), "one at a time"
    refused = talk.stand_in("p2")
    assert isinstance(refused, Refused)
    assert (refused.reason, refused.final, refused.pid) == ("lease is live", False, "evaluator")
    (job,) = talk.poll("p1", epoch)
    assert isinstance(job, EvaluationJob)
    assert job.job == 1
    assert len(talk.report("p1", epoch, 1)) == 1
    talk.send("p1", Release(pid="evaluator", epoch=epoch))
    assert talk.train("p2")
    assert granted_epoch(talk.stand_in("p2")) == epoch + 1


def test_only_the_first_stand_in_is_an_event() -> None:
    talk = invited(Alone())
    told = []
    for _ in range(3):
        actions = talk.send("p1", Claim(role="evaluator", instance="p1", stand_in=True))
        epoch = next(a.message.epoch for a in actions if isinstance(a, Send) and isinstance(a.message, Granted))
        told += of(LogEvent, actions) + of(LogEvent, talk.send("p1", Release(pid="evaluator", epoch=epoch)))
    assert [tell.text for tell in told] == ["no evaluator: the learners' workers evaluate between their turns"]


@pytest.mark.parametrize("instance", ["e", "p1"])
def test_an_evaluator_takes_the_place_from_a_stand_in_at_once(instance: str) -> None:
    talk = invited(Alone())
    epoch = granted_epoch(talk.stand_in("p1"))
    (job,) = talk.poll("p1", epoch)
    assert isinstance(job, EvaluationJob)
    granted = talk.answer("e", Claim(role="evaluator", instance=instance))
    assert isinstance(granted, Granted)
    (refused,) = talk.poll("p1", epoch, busy=True)
    assert isinstance(refused, Refused)
    assert (refused.reason, refused.final, refused.pid) == ("stale epoch", False, "evaluator")
    assert talk.report("p1", epoch, job.job) == []
    assert talk.send("p1", Release(pid="evaluator", epoch=epoch)) == []
    talk.train()
    (fresh,) = talk.poll("e", granted.epoch)
    assert isinstance(fresh, EvaluationJob)
    assert len(talk.report("e", granted.epoch, fresh.job)) == 1


def test_a_stand_in_never_takes_an_evaluators_place_not_even_under_its_name() -> None:
    talk = Alone()
    talk.claim_evaluator("p1")
    assert isinstance(talk.stand_in("p1"), Refused)


def test_a_stand_in_that_is_silent_is_replaced_when_its_lease_is_over() -> None:
    talk = invited(Alone())
    granted_epoch(talk.stand_in("p1"))
    talk.now += 9.0
    assert not talk.train("p2")
    talk.now += 1.1
    assert talk.train("p2")
    granted_epoch(talk.stand_in("p2"))


class Slices:
    """Stands for an evaluation session: so many steps of so many seconds on a clock that it moves itself."""

    def __init__(self, steps: int, step_s: float) -> None:
        self.now = 0.0
        self.place, self.epoch = "evaluator", 0
        self.count, self.step_s = steps, step_s
        self.begun = 0
        self.error: PolicyError | None = None

    def open(self, granted: Granted) -> Any:
        self.epoch = granted.epoch
        return self

    def renew(self, granted: Granted) -> bool:
        self.epoch = granted.epoch
        return True

    def steps(self, envelope: Envelope) -> Generator[None, None, EvaluationReport]:
        self.begun += 1
        assert isinstance(envelope.message, EvaluationJob)
        for _ in range(self.count):
            self.now += self.step_s
            if self.error is not None:
                raise self.error
            yield
        return report_of(envelope.message.job, self.epoch)

    def clock(self) -> float:
        return self.now


class OneWorker:
    """The worker p1 of a conversation: turns of learning, and a stand-in."""

    def __init__(self, session: Slices, talk: Alone) -> None:
        self.session, self.talk = session, talk
        self.said: list[str] = []
        self.sent: list[Message] = []
        self.answers: list[Envelope] = []
        self.learned_s = self.evaluated_s = 0.0
        self.longest_slice = 0.0
        self.stand_in = StandIn("p1", self.send, self.said.append, session.clock, session.open)

    def send(self, message: Message) -> None:
        self.sent.append(message)
        self.talk.now = self.session.now
        for action in self.talk.state.handle(Received(self.talk.now, b"p1", Envelope(message, {}, "p1", STAND_IN))):
            if isinstance(action, Send):
                assert action.answers == STAND_IN
                self.answers.append(Envelope(action.message, action.arrays, "", action.answers))

    def turn(self, learn_s: float) -> None:
        began = self.session.now
        if self.stand_in.turn():
            self.evaluated_s += self.session.now - began
            self.longest_slice = max(self.longest_slice, self.session.now - began)
        elif not self.stand_in.waiting:
            self.session.now += learn_s
            self.learned_s += learn_s
        self.hear()
        self.stand_in.tell()

    def hear(self) -> None:
        self.talk.now = self.session.now
        if self.talk.train():
            self.stand_in.invited()
        while self.answers:
            self.stand_in.take(self.answers.pop(0))


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(st.integers(1, 60), st.floats(0.02, 0.5), st.floats(0.3, 4.0))
def test_a_worker_evaluates_for_a_tenth_of_its_time_at_most(steps: int, step_s: float, learn_s: float) -> None:
    session = Slices(steps, step_s)
    worker = OneWorker(session, Alone())
    one = steps * step_s
    while session.now < 300.0:
        worker.turn(learn_s)
        assert worker.evaluated_s <= TIME_SHARE * session.now + one + 1e-6
    assert session.begun >= 1 + (300 - STAND_IN_AFTER_S - 10 * one - 8 * learn_s) // (12 * one + 8 * learn_s + 3)
    assert worker.longest_slice <= SLICE_S + step_s + 1e-6
    assert worker.said == []
    reports = [message for message in worker.sent if isinstance(message, EvaluationReport)]
    assert len(worker.talk.state.evaluations.history) == len(reports) >= 1


def test_spare_time_is_a_tenth_and_the_first_is_free() -> None:
    spare = SpareTime(began=100.0)
    assert spare.allows(100.0)
    spare.spent += 2.0
    assert not spare.allows(119.9)
    assert spare.allows(120.1)


def test_signs_of_life_are_sent_however_long_an_evaluation_takes() -> None:
    worker = OneWorker(Slices(steps=400, step_s=0.1), Alone())
    while not worker.talk.state.evaluations.history:
        worker.turn(1.0)
        assert worker.session.now < 100
    polls = [message for message in worker.sent if isinstance(message, EvaluationPoll)]
    assert [poll.busy for poll in polls] == [False] + [True] * (len(polls) - 1)
    assert 40 / 0.8 <= len(polls) <= 40 / 0.4


def test_a_stand_in_that_lost_its_place_drops_the_evaluation_and_learns_on() -> None:
    worker = OneWorker(Slices(steps=400, step_s=0.1), Alone())
    while not worker.evaluated_s:
        worker.turn(1.0)
    worker.talk.claim_evaluator("e")
    before = worker.learned_s
    for _ in range(20):
        worker.turn(1.0)
    assert worker.learned_s > before + 10
    assert worker.evaluated_s < 2.0
    assert worker.talk.state.evaluations.history == []
    assert worker.said == []


def test_an_evaluation_that_is_not_due_any_more_gives_the_place_back() -> None:
    sent: list[Message] = []
    stand_in = StandIn("p1", sent.append, lambda text: None, lambda: 0.0, Slices(1, 0.0).open)
    stand_in.invited()
    talk = Alone()
    stand_in.take(Envelope(granted_evaluator(talk), {}, "", STAND_IN))
    stand_in.tell()
    stand_in.take(Envelope(EvaluationJob(job=0), {}, "", STAND_IN))
    assert [type(message) for message in sent] == [Claim, EvaluationPoll, Release]
    assert not stand_in.turn()
    assert not stand_in.waiting
    stand_in.close()
    assert len(sent) == 3


def granted_evaluator(talk: Conversation) -> Granted:
    return talk.claim_evaluator("p1")


def test_an_evaluation_that_fails_is_told_and_not_tried_again() -> None:
    session = Slices(10, 0.1)
    session.error = PolicyError("expected observations of size 3")
    worker = OneWorker(session, Alone())
    for _ in range(60):
        worker.turn(1.0)
    assert worker.said == ["does not evaluate any more: expected observations of size 3"]
    assert session.begun == 1
    assert worker.learned_s > 40


def test_an_evaluator_reports_its_processor_time_once_and_asks_for_more() -> None:
    session, sent = Slices(5, 0.1), list[Message]()
    work = EvaluationWork(session, sent.append, session.clock)  # type: ignore[arg-type]
    work.tell()
    work.take(Envelope(EvaluationJob(job=7), {}))
    slices = 0
    while work.busy:
        work.advance()
        slices += 1
    work.tell()
    assert 3 <= slices <= 4
    assert [type(message) for message in sent] == [EvaluationPoll, EvaluationReport, EvaluationPoll]
    report = sent[1]
    assert isinstance(report, EvaluationReport)
    assert (report.job, report.processor_s > 0) == (7, True)


def test_an_evaluation_step_by_step_is_the_same_as_at_once() -> None:
    task = small_task()
    learners = {
        pid: build_learner(task, pid, InitialStateBuffer(10), task.method(), seed=0) for pid in task.decomposition.pids
    }
    actors = {pid: acting_parameters(learner.weights()) for pid, learner in learners.items()}
    policy = GlobalPolicy(task, [(0, "p1", 1.0)], actors)
    at_once, in_steps = (Evaluator(policy, 4, seed=3) for _ in range(2))
    expected = at_once.run(policy, perturb=2)
    results = []

    def steps() -> Generator[None, None, None]:
        results.append((yield from in_steps.steps(policy, perturb=2)))

    count, result = len(list(steps())), results[0]
    assert count >= expected.lengths.max() - 1 > 0
    assert result.lengths.tolist() == expected.lengths.tolist()
    assert result.returns.tolist() == expected.returns.tolist()
    assert result.dfa_path == expected.dfa_path


def test_an_evaluation_longer_than_the_patience_hears_the_coordinator_and_goes_on() -> None:
    session, sent = Slices(400, 1.0), list[Message]()
    work = EvaluationWork(session, sent.append, session.clock)  # type: ignore[arg-type]
    talk = Alone()
    talk.train()
    epoch = talk.claim_evaluator("e").epoch
    state = WorkerState("evaluator", "e", [], "tcp://x", "", 60.0, 0.0)
    for _ in range(200):
        work.tell()
        for message in sent:
            if isinstance(message, EvaluationPoll):
                for answer in talk.poll("e", epoch, busy=message.busy):
                    state.receive(session.now, answer)
                    work.take(Envelope(answer, {}))
        sent.clear()
        assert not any(isinstance(action, Exit) for action in state.tick(session.now))
        work.advance()
        talk.now = session.now
    assert (session.begun, work.busy) == (1, True)
