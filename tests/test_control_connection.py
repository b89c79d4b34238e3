"""The connection to the coordinator: leases are renewed whatever the loop does, but not in silence if it hangs."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import slow_environments
from hypothesis import given
from hypothesis import strategies as st
from small_tasks import TINY, own_task

from coordinator.endpoints import Access
from coordinator.service import CoordinatorService, RunStorage
from coordinator.state import CoordinatorState, RunSettings
from t4nmtd_dist.environments.preparation import prepared
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.tasks import load_task
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import (
    EvaluationJob,
    EvaluationPoll,
    Goodbye,
    Granted,
    LearnerStats,
    Message,
    Refused,
    Release,
    Sync,
    SyncReply,
)
from workers import loop_watch
from workers.control_connection import STOPPED_S, StopClock
from workers.lease_renewal import RENEWAL, LeaseRenewals
from workers.loop_watch import LoopWatch, place_of
from workers.options import Connection, WorkerOptions
from workers.stand_in import STAND_IN
from workers.worker import Worker

FREE_PORT = "tcp://127.0.0.1:*"
WAIT_S = 60.0
LEASE_S = 8.0


def report(pid: str = "p1", epoch: int = 1) -> Envelope:
    return Envelope(Sync(pid=pid, epoch=epoch, sequence=3, version=2, start_cursor=5, stats=LearnerStats()))


def poll(epoch: int = 1, number: int = 0) -> Envelope:
    return Envelope(EvaluationPoll(epoch=epoch), id=number)


def refusal(pid: str, number: int = 0) -> Envelope:
    return Envelope(Refused(reason="stale epoch", text="over", final=False, pid=pid), id=number)


def reply(pid: str = "p1") -> SyncReply:
    return SyncReply(pid=pid, epoch=1, accepted_sequence=3, start_cursor=7, q_table=[], peers={})


def granted() -> Granted:
    return Granted(
        role="learner", pid="p1", epoch=1, lease_s=LEASE_S, seed=0, task={}, dfa={}, decomposition={}, rho=[]
    )


def renewals() -> LeaseRenewals:
    made = LeaseRenewals()
    made.received(Envelope(granted()))
    return made


def renewed(made: LeaseRenewals, now: float) -> list[Message]:
    return [envelope.message for envelope in made.due(now)]


def test_a_grant_alone_is_not_renewed_for_the_loop_may_not_want_it() -> None:
    assert renewals().due(1e6) == []


def test_what_was_reported_under_is_renewed_without_progress_until_it_is_released() -> None:
    made = renewals()
    made.sent(report(), 0.0)
    assert made.due(LEASE_S / 4 - 0.01) == []
    (sign,) = renewed(made, LEASE_S / 4)
    assert isinstance(sign, Sync)
    assert (sign.pid, sign.epoch, sign.sequence, sign.version) == ("p1", 1, 0, 0)
    assert renewed(made, LEASE_S / 4 + 0.01) == []
    made.sent(Envelope(Release(pid="p1", epoch=1)), LEASE_S)
    assert made.due(1e6) == []


@given(st.lists(st.floats(0.0, LEASE_S), min_size=1, max_size=30), st.floats(0.05, LEASE_S / 4))
def test_no_lease_waits_longer_than_an_interval_whenever_the_loop_reports(gaps: list[float], tick: float) -> None:
    made, now, last = renewals(), 0.0, 0.0
    for gap in gaps:
        made.sent(report(), now)
        last, end = now, now + gap
        while now < end:
            now += tick
            if made.due(now):
                last = now
            assert now - last < LEASE_S / 4 + tick


@pytest.mark.parametrize("number", [0, STAND_IN])
def test_an_evaluators_place_is_renewed_as_busy_until_it_is_given_back_or_refused(number: int) -> None:
    for end in (lambda made: made.sent(Envelope(Release(pid="evaluator", epoch=4), id=number), 9.0), None):
        made = renewals()
        made.sent(poll(4, number), 0.0)
        (envelope,) = made.due(LEASE_S)
        assert envelope == Envelope(EvaluationPoll(epoch=4, busy=True), id=RENEWAL + number)
        if end is None:
            forwarded, quiet = made.received(refusal("evaluator", RENEWAL + number))
            assert (forwarded.id, quiet) == (number, False)
        else:
            end(made)
        assert made.due(1e6) == []


def test_the_loop_sees_refusals_of_renewals_and_not_their_answers() -> None:
    made = renewals()
    made.sent(report(), 0.0)
    made.sent(report("g"), 0.0)
    for message in (reply(), EvaluationJob(job=0)):
        assert made.received(Envelope(message, id=RENEWAL))[1]
        assert not made.received(Envelope(message))[1]
    assert not made.received(Envelope(Goodbye(reason="solved"), id=RENEWAL))[1]
    assert made.received(refusal("p1", RENEWAL)) == (refusal("p1"), False)
    assert [sign.pid for sign in renewed(made, 1e6) if isinstance(sign, Sync)] == ["g"]
    made.forget("g")
    assert made.due(1e9) == []


def test_time_in_which_the_process_did_not_run_is_known_at_once_and_counted_once() -> None:
    clock = StopClock(0.0)
    for beat in range(1, 11):
        clock.beat(beat / 10)
    assert clock.stopped_s(1.0 + STOPPED_S) == 0.0
    assert clock.stopped_s(501.0) == 500.0, "the loop may ask before the thread has noticed"
    clock.beat(501.0)
    clock.beat(501.1)
    assert clock.stopped_s(501.2) == 500.0


class Still:
    """A loop that makes a step when told to."""

    def __init__(self) -> None:
        self.steps = 0

    def name(self) -> str:
        return "p1"

    def progress(self) -> int:
        return self.steps

    def where(self) -> str:
        return "Corridor.step (my.py:7)"


def test_a_loop_without_a_step_is_told_of_ever_more_rarely_and_counts_as_hung_in_the_end() -> None:
    loop = Still()
    watch, told = LoopWatch(loop, 0.0), dict[int, str]()
    for now in range(1, 1000):
        line = watch.check(float(now), 0.0)
        if line is not None:
            told[now - 1] = line
        assert watch.hangs == (now - 1 >= loop_watch.HUNG_S)
    assert list(told) == [60, 120, 240, 480, 600, 960]
    assert told[60] == "p1: no step for 60 s, inside Corridor.step (my.py:7)"
    assert told[600].endswith("its lease is not renewed any more")
    loop.steps += 1
    assert watch.check(1000.0, 0.0) is None
    assert not watch.hangs


def test_time_in_which_the_process_was_stopped_is_no_hang() -> None:
    watch = LoopWatch(Still(), 0.0)
    watch.check(0.0, 0.0)
    assert watch.check(5000.0, 4950.0) is None
    assert not watch.hangs


def test_the_place_of_a_thread_is_the_last_call_out_of_our_code_and_the_innermost_one() -> None:
    slow_environments.GO.clear()
    try:
        thread = threading.Thread(target=slow_environments.Stuck().step, args=(0,), daemon=True)
        thread.start()
        until(lambda: "wait" in place_of(thread.ident or 0), "the thread waits")
    finally:
        slow_environments.GO.set()
    thread.join(WAIT_S)
    assert place_of(thread.ident or 0) == "a thread that has ended"


def until(holds: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + WAIT_S
    while not holds():
        assert time.monotonic() < deadline, what
        time.sleep(0.02)


def corridor(environment: str, folder: Path, *flags: str) -> CompiledTask:
    text = f"""
name = "corridor"
formula = "F(left & X(F(right)))"
propositions = ["left", "right", "again"]
[environment]
id = "slow_environments:{environment}"
path = "{Path(__file__).parent}"
horizon = 30
[learner]
algorithm = "ppo"
"""
    return prepared(compile_task(load_task(str(own_task(folder, text)), flags=[*TINY, *flags]), translator="python"))


@contextmanager
def at_work(state: CoordinatorState, folder: Path) -> Iterator[None]:
    """A coordinator and one worker without a pid, each in a thread."""
    service = CoordinatorService(state, RunStorage(folder / "run"), Access(FREE_PORT, FREE_PORT))
    serving = threading.Thread(target=service.serve, daemon=True)
    serving.start()
    worker = Worker(WorkerOptions(Connection(service.control, trust=True), instance="w"))
    over = threading.Event()

    def work() -> None:
        while not over.is_set():
            worker._turn()
        worker._close()

    working = threading.Thread(target=work, daemon=True)
    working.start()
    try:
        yield
    finally:
        over.set()
        service.interrupt("the test is over")
        working.join(WAIT_S)
        serving.join(WAIT_S)


def texts(state: CoordinatorState) -> list[str]:
    return [line.text for line in list(state.events)]


@pytest.mark.slow
def test_no_lease_is_lost_while_environments_take_longer_than_it_to_be_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coordinator.stand_ins.STAND_IN_AFTER_S", 0.0)
    task = corridor("Slow", tmp_path, "evaluation.every=1", "evaluation.episodes=5")
    state = CoordinatorState(task, RunSettings(0, 10**9, lease_s=3.0))
    monkeypatch.setattr(slow_environments, "OPENING_S", 0.9)  # four of a learner, five of an evaluation
    expired: list[float] = []
    with at_work(state, tmp_path):
        until(lambda: state.evaluator_lease.get("evaluator"), "the worker stands in")
        began = time.monotonic()

        def evaluated() -> bool:
            lease, now = state.evaluator_lease.get("evaluator"), time.monotonic()
            if lease is not None and not lease.released and lease.expires < now:
                expired.append(now - began)
            return bool(state.evaluations.history)

        until(evaluated, "an evaluation is reported")
        assert time.monotonic() - began > 3.0, "opening took longer than a lease"
    assert expired == []
    assert not [text for text in texts(state) if " lost: " in text]


@pytest.mark.slow
def test_a_loop_that_hangs_in_an_environment_is_told_of_with_its_place_and_loses_its_lease_in_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop_watch, "FIRST_WARNING_S", 0.5)
    monkeypatch.setattr(loop_watch, "HUNG_S", 2.0)
    state = CoordinatorState(corridor("Stuck", tmp_path), RunSettings(0, 10**9, lease_s=1.5))
    with at_work(state, tmp_path):
        until(lambda: state.interactions, "it learns")
        slow_environments.GO.clear()
        try:
            until(lambda: any("no step for" in text for text in texts(state)), "it is told of")
            line = next(text for text in texts(state) if "no step for" in text)
            assert "inside Stuck.step (slow_environments.py:" in line
            until(lambda: any(" lost: " in text for text in texts(state)), "its lease is over")
            assert any("its lease is not renewed any more" in text for text in texts(state))
        finally:
            slow_environments.GO.set()
        until(lambda: any(text.endswith("heard again") for text in texts(state)), "it goes on")
