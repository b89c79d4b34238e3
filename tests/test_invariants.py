"""``validate`` of both state machines: it holds between events, and fails on each state that must not be."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from coordinator_events import Conversation, changes, starts, weights
from hypothesis import given
from hypothesis import strategies as st

from coordinator.state import CoordinatorState
from t4nmtd_dist.core.invariants import InvariantError, Monotone
from t4nmtd_dist.method.start_states import CAPACITY
from t4nmtd_dist.wire.messages import (
    EvaluationJob,
    EvaluationPoll,
    EvaluationReport,
    EventLine,
    Granted,
    Intervention,
    LearnerStats,
    Refused,
)
from workers.state import LONGEST_RETRY_S, WorkerState


def trained() -> CoordinatorState:
    """A coordinator after a lease, progress, weights, start states, an evaluation, and with another under way."""
    talk = Conversation("evaluation.every=1")
    epoch = talk.claim_evaluator("e").epoch
    talk.claim("g", "w")
    talk.now = 1.0
    for number in (1, 2):
        stats = LearnerStats(phase="training", interactions=20 * number, processor_s=100.0 * number)
        sent = changes((0, 1, 3, 2.0)) | starts((1, number)) | weights()
        talk.sync("g", "w", sequence=number, version=number, stats=stats, arrays=sent)
        job = talk.answer("e", EvaluationPoll(epoch=epoch))
        assert isinstance(job, EvaluationJob)
        assert job.job == number
        if number == 1:
            talk.send("e", report(epoch, job.job))
    talk.state.validate()
    return talk.state


def report(epoch: int, job: int) -> EvaluationReport:
    figures = {"mean_length": 1.0, "std_length": 0.0, "mean_return": 0.0}
    return EvaluationReport(epoch=epoch, job=job, success_rate=0.5, episodes=1, dfa_path=[0], **figures)


def lease(**changed: Any) -> Callable[[CoordinatorState], None]:
    """Replace fields of the lease on g."""

    def change(state: CoordinatorState) -> None:
        held = state.leases.get("g")
        assert held is not None
        state.leases._leases["g"] = dataclasses.replace(held, **changed)

    return change


def record(pid: str = "g", **changed: Any) -> Callable[[CoordinatorState], None]:
    """Set attributes of a learner's record."""

    def change(state: CoordinatorState) -> None:
        for name, value in changed.items():
            setattr(state.records[pid], name, value)

    return change


def buffered(q: int, pid: str = "g") -> Callable[[CoordinatorState], None]:
    """A start state in a DFA state."""
    return lambda state: state.records[pid].buffer.add(q, np.zeros(2)) and None


def numbered_too_low(state: CoordinatorState) -> None:
    buffered(1)(state)
    state.records["g"].buffer.cursor = 0


def overfull(state: CoordinatorState) -> None:
    buffer = state.records["g"].buffer
    buffer._capacity = 10**9
    for number in range(CAPACITY + 1):
        buffer.add(1, np.array([number]))


def q_entry(q: int, pid: str, value: float) -> Callable[[CoordinatorState], None]:
    return lambda state: state.method.load([(q, pid, value)])


def pending(**changed: Any) -> Callable[[CoordinatorState], None]:
    """Replace fields of the evaluation under way."""

    def change(state: CoordinatorState) -> None:
        assert state.evaluations.pending is not None
        state.evaluations.pending = dataclasses.replace(state.evaluations.pending, **changed)

    return change


def no_best(state: CoordinatorState) -> None:
    state.evaluations.best = None


def a_worse_best(state: CoordinatorState) -> None:
    state.evaluations.history[0] = msgspec.structs.replace(state.evaluations.history[0], success_rate=0.6)


def repeated_evaluation(state: CoordinatorState) -> None:
    state.evaluations.history.append(state.evaluations.history[0])


def solved_and_going_on(state: CoordinatorState) -> None:
    history = state.evaluations.history
    history[:] = [msgspec.structs.replace(history[0], job=job, success_rate=1.0) for job in range(1, 6)]
    state.evaluations.pending, state.evaluations.best = (
        None,
        dataclasses.replace(state.evaluations.best, row=history[0]),
    )


def set_of(part: str, name: str, value: Any) -> Callable[[CoordinatorState], None]:
    """Set an attribute of a part of the state."""
    return lambda state: setattr(getattr(state, part) if part else state, name, value)


def event(elapsed_s: float, times: int = 1) -> Callable[[CoordinatorState], None]:
    line = EventLine(elapsed_s=elapsed_s, text="mutated")

    def change(state: CoordinatorState) -> None:
        state._log.lines = type(state.events)([*state.events, *[line] * times])

    return change


BROKEN: dict[str, tuple[Callable[[CoordinatorState], Any], str]] = {
    "lease on an unknown place": (lease(place="p9"), "no known place"),
    "lease of an old epoch": (lambda state: state.leases.raise_epochs({"g": 7}), "newest 7"),
    "lease heard in the future": (lease(heard=5.0, expires=6.0), "in the future"),
    "lease that never expires": (lease(expires=1e9), "out of turn"),
    "released lease that lasts": (lease(released=True), "released and lasts"),
    "lost under a live lease": (record(lost=True), "counts as lost"),
    "unknown stand-in": (set_of("stand_ins", "epoch", 9), "stand-in holds epoch 9"),
    "missing record": (lambda state: state.records.pop("p1"), "records and leases"),
    "unknown record": (lambda state: state.records.update(p9=state.records["g"]), "records and leases"),
    "negative count": (record(current=LearnerStats(interactions=-1)), "interactions = -1"),
    "negative count of a part": (record(current=LearnerStats(intervention=Intervention(late=-1))), "late = -1"),
    "count beyond its bound": (record(earlier=LearnerStats(attempts=2**60)), "attempts = "),
    "statistic that is not finite": (record(current=LearnerStats(entropy=float("nan"))), "entropy = nan"),
    "negative sequence": (record(sequence=-1), "sequence -1"),
    "negative version": (record("p1", version=-1), "version -1"),
    "version without weights": (record("p1", version=3), "with other weights"),
    "weights without version": (record(version=0), "with other weights"),
    "start states numbered too low": (numbered_too_low, "numbered up to 0"),
    "start state in an unknown DFA state": (buffered(99), "no such DFA state"),
    "start state in a terminal state": (buffered(5), "terminal"),
    "start state of another sub-task": (buffered(0), "not available"),
    "overfull buffer": (overfull, "are kept"),
    "start state of two dimensions": (set_of("", "snapshot", np.zeros((2, 2))), "more than one dimension"),
    "Q that is not finite": (q_entry(0, "g", float("inf")), "= inf"),
    "Q of an unknown sub-task": (q_entry(0, "p9", 1.0), "no such DFA state or sub-task"),
    "Q of an unknown state": (q_entry(99, "g", 1.0), "no such DFA state or sub-task"),
    "evaluation reported twice": (repeated_evaluation, "out of order"),
    "time of evaluations": (set_of("evaluations", "processor_s", -1.0), "took -1.0 s"),
    "old evaluation under way": (pending(job=1), "under way after"),
    "evaluation of unknown versions": (pending(versions={"g": 9}), "not known"),
    "evaluation without weights": (pending(weights={}), "not those of its versions"),
    "no best policy": (no_best, "better than the best"),
    "a better policy than the best": (a_worse_best, "better than the best"),
    "solved and going on": (solved_and_going_on, "the run goes on"),
    "events out of order": (event(-1.0), "out of order"),
    "too many events": (event(9.0, times=60), "lines are kept"),
    "epoch that falls": (lambda state: state.leases._epochs.update(p1=-1), "epoch of p1 fell"),
    "clock that goes back": (set_of("clock", "earlier_s", -5.0), "elapsed_s fell"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_coordinator_in_a_state_that_must_not_be_is_found_out(name: str) -> None:
    mutate, text = BROKEN[name]
    state = trained()
    mutate(state)
    with pytest.raises(InvariantError, match=text):
        state.validate()


def test_every_event_is_followed_by_validation_in_tests() -> None:
    talk = Conversation()
    record("p1", version=3)(talk.state)
    with pytest.raises(InvariantError):
        talk.tick()


# Workers


def granted(pid: str, role: Any = "learner") -> Granted:
    return Granted(
        role=role, pid=pid, epoch=1, lease_s=10.0, seed=0, task={}, dfa={}, decomposition={}, rho=[]
    )  # fmt: skip


def worker(*pids: str, role: Any = "learner") -> WorkerState:
    return WorkerState(role, "w", pids, "tcp://127.0.0.1:1", "tcp://127.0.0.1:2", 30.0, 0.0)


def holding(*pids: str, role: Any = "learner") -> WorkerState:
    state = worker(*([] if role == "evaluator" else pids), role=role)
    state.tick(0.0)
    for pid in pids:
        state.receive(0.1, granted(pid, role))
    return state


def place(**changed: Any) -> Callable[[WorkerState], None]:
    """Set attributes of the last place of a worker."""

    def change(state: WorkerState) -> None:
        for name, value in changed.items():
            setattr(state._places[-1], name, value)

    return change


def worker_attribute(name: str, value: Any) -> Callable[[WorkerState], None]:
    return lambda state: setattr(state, name, value)


def one_more_place(state: WorkerState) -> None:
    state._places.append(dataclasses.replace(state._places[0]))


BROKEN_WORKERS: dict[str, tuple[WorkerState, Callable[[WorkerState], Any], str]] = {
    "a place held twice": (holding("p1", "p2"), place(wanted="p1", held="p1"), "held twice"),
    "held and kept": (holding("g"), place(kept="p1"), "in the place of"),
    "claims without a pause": (holding("g"), place(retry=0.0), "0.0 s apart"),
    "claims too rare": (holding("g"), place(retry=2 * LONGEST_RETRY_S), "s apart"),
    "held what was not wanted": (holding("g"), place(held="h"), "was wanted"),
    "standing by while holding": (holding("g"), worker_attribute("_standing_by", True), "standing by"),
    "an evaluator that learns": (holding("evaluator", role="evaluator"), place(held="g"), "evaluator holds g"),
    "an evaluator that keeps": (worker(role="evaluator"), place(kept="g"), "keeps g"),
    "an evaluator of several places": (worker(role="evaluator"), one_more_place, "several places"),
    "an evaluator that waits for a share": (worker(role="evaluator"), worker_attribute("_share_due", 1.0), "share"),
}


@pytest.mark.parametrize("name", BROKEN_WORKERS)
def test_a_worker_in_a_state_that_must_not_be_is_found_out(name: str) -> None:
    state, mutate, text = BROKEN_WORKERS[name]
    state.validate()
    mutate(state)
    with pytest.raises(InvariantError, match=text):
        state.validate()


@given(
    st.lists(
        st.one_of(
            st.builds(granted, st.sampled_from(["p1", "p2", "g"])),
            st.builds(
                Refused,
                reason=st.sampled_from(["lease is live", "nothing free", "stale epoch"]),
                text=st.just("refused"),
                final=st.booleans(),
                pid=st.sampled_from([None, "p1", "p2", "g"]),
            ),
            st.sampled_from(["tick", "forget", "deaf"]),
        ),
        max_size=30,
    ),
    st.sampled_from([(), ("p1",), ("p1", "p2")]),
)
def test_no_sequence_of_answers_breaks_a_worker(events: list[Any], pids: tuple[str, ...]) -> None:
    state = worker(*pids)
    for second, told in enumerate(events):
        if told == "tick":
            state.tick(float(second))
        elif told == "forget":
            state.forget("p1", float(second))
        elif told == "deaf":
            state.discount_blocked_time(float(second), second + 0.5)
        else:
            state.receive(float(second), told)
        state.validate()


def test_numbers_that_may_only_grow_are_remembered() -> None:
    growing = Monotone()
    growing.check({"a": 1})
    growing.check({"a": 1, "b": 5})
    for numbers in ({"a": 0, "b": 5}, {"a": 1}):
        with pytest.raises(InvariantError):
            growing.check(numbers)
    growing.check({"a": 2, "b": 5})
