"""A worker's claims and leases by lists of events: patience, refusals, shares, and the end of a run."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, TypeVar

import pytest
from coordinator_events import Conversation
from hypothesis import example, given, settings
from hypothesis import strategies as st

from t4nmtd_dist.wire.messages import Claim, Failure, Goodbye, Granted, Refused, Role
from workers.state import Action, Exit, Print, SendClaim, SendRelease, StartWork, StopWork, WorkerState

ENDPOINT = "tcp://127.0.0.1:5570"
WAIT_S = 60.0

T = TypeVar("T")


def worker(*pids: str, role: Role = "learner") -> WorkerState:
    return WorkerState(role, "host:1", pids, ENDPOINT, "tcp://127.0.0.1:9", WAIT_S, now=0.0)


def granted(pid: str, epoch: int = 1, role: Role = "learner") -> Granted:
    return Granted(
        role=role,
        pid=pid,
        epoch=epoch,
        lease_s=10.0,
        seed=0,
        task={},
        dfa={},
        decomposition={},
        rho=[],
    )


def of(kind: type[T], actions: list[Action]) -> list[T]:
    return [action for action in actions if isinstance(action, kind)]


def asks(state: WorkerState, until: float, step: float = 0.05) -> list[tuple[float, Claim]]:
    """Every claim made while time passes without an answer, with its time."""
    found = []
    for tick in range(1, int(until / step) + 1):
        found += [(tick * step, ask.claim) for ask in of(SendClaim, state.tick(tick * step))]
    return found


NOTHING_FREE = Refused(reason="nothing free", text="every sub-task has a learner; standing by", final=False)


def test_the_first_claim_comes_at_once_and_says_who_asks() -> None:
    (ask,) = of(SendClaim, worker("p1").tick(0.0))
    assert ask.claim == Claim(role="learner", instance="host:1", pid="p1", critic_endpoint="tcp://127.0.0.1:9")


def test_claims_are_repeated_ever_more_slowly() -> None:
    times = [time for time, _ in asks(worker("p1"), 30.0)]
    gaps = [b - a for a, b in pairwise(times)]
    assert gaps[0] < 0.5
    assert all(b >= a - 0.06 for a, b in pairwise(gaps))
    assert max(gaps) < 5.0


def test_every_pid_is_claimed() -> None:
    assert {ask.claim.pid for ask in of(SendClaim, worker("p1", "g").tick(0.0))} == {"p1", "g"}


def test_an_evaluator_claims_no_pid() -> None:
    (ask,) = of(SendClaim, worker(role="evaluator").tick(0.0))
    assert (ask.claim.role, ask.claim.pid) == ("evaluator", None)


def test_waiting_is_told_from_time_to_time() -> None:
    state = worker("p1")
    said = [say.text for tick in range(1, 301) for say in of(Print, state.tick(tick * 0.1))]
    assert 3 <= len(said) <= 12
    assert all(ENDPOINT in text for text in said)


def test_it_gives_up_after_the_wait_and_names_the_endpoint() -> None:
    state = worker("p1")
    assert of(Exit, state.tick(WAIT_S - 0.1)) == []
    (end,) = of(Exit, state.tick(WAIT_S + 0.1))
    assert end.code == 2
    assert ENDPOINT in end.text
    assert "60" in end.text


def test_any_word_of_the_coordinator_starts_the_wait_anew() -> None:
    state = worker("p1")
    state.receive(WAIT_S - 1, Failure(text="?"))
    assert of(Exit, state.tick(2 * WAIT_S - 2)) == []
    assert len(of(Exit, state.tick(2 * WAIT_S))) == 1


def test_time_in_which_the_worker_itself_was_stopped_is_no_silence() -> None:
    state = worker("p1")
    state.receive(1.0, granted("p1"))
    state.discount_blocked_time(2.0, 500.0)
    assert of(Exit, state.tick(500.0)) == []
    assert len(of(Exit, state.tick(500.0 + WAIT_S))) == 1


def test_a_grant_begins_work_and_ends_the_claims() -> None:
    state = worker("p1")
    state.tick(0.0)
    (begin,) = of(StartWork, state.receive(0.1, granted("p1")))
    assert begin.granted.pid == "p1"
    assert state.held == ["p1"]
    assert asks(state, 20.0) == []


@pytest.mark.parametrize("reason", ["unknown pid", "lease is live"])
def test_a_final_refusal_ends_the_process_with_its_text(reason: Any) -> None:
    state = worker("p9")
    (end,) = of(Exit, state.receive(0.1, Refused(reason=reason, text="because", final=True, pid="p9")))
    assert (end.code, end.text) == (2, "because")


def test_without_a_free_subtask_it_stands_by_and_says_so_once() -> None:
    state = worker()
    state.tick(0.0)
    assert [say.text for say in of(Print, state.receive(0.1, NOTHING_FREE))] == [NOTHING_FREE.text]
    for second in range(1, 200):
        claims = of(SendClaim, state.tick(second * 1.2))
        assert len(claims) == 1
        assert state.receive(second * 1.2 + 0.1, NOTHING_FREE) == []
    assert len(of(StartWork, state.receive(300.0, granted("p3")))) == 1


def test_a_worker_without_pids_takes_a_further_share_later() -> None:
    state = worker()
    state.tick(0.0)
    state.receive(0.1, granted("p1"))
    assert of(SendClaim, state.tick(1.0)) == []
    assert [ask.claim.pid for ask in of(SendClaim, state.tick(20.0))] == [None]
    state.receive(20.1, granted("p2"))
    assert state.held == ["p1", "p2"]


def test_a_worker_with_pids_takes_no_further_share() -> None:
    state = worker("p1")
    state.tick(0.0)
    state.receive(0.1, granted("p1"))
    assert of(SendClaim, state.tick(50.0)) == []


def test_a_lease_granted_twice_over_is_given_back() -> None:
    """Two claims without a pid crossed a slow answer: the second lease would lie idle."""
    state = worker()
    state.tick(0.0)
    state.tick(0.5)
    state.receive(0.6, granted("p1"))
    assert state.receive(0.7, granted("p2", epoch=3)) == [SendRelease(granted("p2", epoch=3))]
    assert state.held == ["p1"]


def test_the_same_pid_granted_again_goes_on_under_the_newer_epoch() -> None:
    state = worker("p1")
    state.tick(0.0)
    state.receive(0.1, granted("p1", epoch=1))
    (begin,) = of(StartWork, state.receive(0.2, granted("p1", epoch=2)))
    assert begin.granted.epoch == 2
    assert state.held == ["p1"]


def test_a_lease_that_another_took_over_ends_the_worker_of_that_pid() -> None:
    state = worker("p1")
    state.receive(0.1, granted("p1"))
    actions = state.receive(5.0, Refused(reason="stale epoch", text="over", final=True, pid="p1"))
    assert of(StopWork, actions) == [StopWork("p1", "over")]
    assert of(Exit, actions) == [Exit(2, "over")]


def test_the_other_pids_of_a_worker_go_on() -> None:
    state = worker("p1", "g")
    state.receive(0.1, granted("p1"))
    state.receive(0.1, granted("g"))
    actions = state.receive(5.0, Refused(reason="stale epoch", text="over", final=True, pid="p1"))
    assert of(StopWork, actions) == [StopWork("p1", "over")]
    assert of(Exit, actions) == []
    assert state.held == ["g"]
    assert asks(state, 20.0) == []


def test_a_worker_without_pids_that_loses_its_lease_looks_for_another() -> None:
    state = worker()
    state.receive(0.1, granted("p1"))
    actions = state.receive(1.0, Refused(reason="stale epoch", text="over", final=True, pid="p1"))
    assert of(Exit, actions) == []
    assert [ask.claim.pid for ask in of(SendClaim, state.tick(1.1))] == [None]


def test_after_a_restart_of_the_coordinator_the_lease_is_claimed_again() -> None:
    state = worker("p1")
    state.receive(0.1, granted("p1", epoch=4))
    actions = state.receive(5.0, Refused(reason="stale epoch", text="unknown here", final=False, pid="p1"))
    assert (of(StopWork, actions), of(Exit, actions)) == ([], []), "what was learned is kept"
    assert [ask.claim.pid for ask in of(SendClaim, state.tick(5.1))] == ["p1"]
    assert len(of(StartWork, state.receive(5.2, granted("p1", epoch=1)))) == 1


def test_after_a_restart_a_worker_without_pids_asks_for_what_it_held() -> None:
    state = worker()
    state.receive(0.1, granted("p2", epoch=4))
    actions = state.receive(1.0, Refused(reason="stale epoch", text="unknown here", final=False, pid="p2"))
    assert (of(StopWork, actions), of(Exit, actions)) == ([], []), "what was learned is kept"
    assert [ask.claim.pid for ask in of(SendClaim, state.tick(1.1))] == ["p2"]
    refused = Refused(reason="lease is live", text="another was faster", final=True, pid="p2")
    actions = state.receive(1.2, refused)
    assert ([end.pid for end in of(StopWork, actions)], of(Exit, actions)) == (["p2"], [])
    assert [ask.claim.pid for ask in of(SendClaim, state.tick(1.3))] == [None]


@settings(deadline=None)
@given(order=st.permutations(range(4)), faster=st.booleans())
def test_after_a_restart_everybody_goes_on_with_what_is_held_or_ends_it(order: list[int], faster: bool) -> None:
    """``faster``: a worker that stood by claims a sub-task before its learner hears of the restart."""
    workers = {f"w{number}": WorkerState("learner", f"w{number}", (), ENDPOINT, "", WAIT_S, 0.0) for number in range(4)}
    working: dict[str, set[str]] = {name: set() for name in workers}

    def follow(talk: Conversation, name: str, now: float, actions: list[Action]) -> None:
        for action in actions:
            if isinstance(action, SendClaim):
                for sent in talk.answers(name, action.claim):
                    follow(talk, name, now, workers[name].receive(now, sent.message))
            elif isinstance(action, StartWork):
                working[name].add(action.granted.pid)
            elif isinstance(action, StopWork):
                working[name].discard(action.pid)

    first, second = Conversation(), Conversation()
    for name, state in workers.items():
        follow(first, name, 0.0, state.tick(0.0))
    before = {name: set(pids) for name, pids in working.items()}
    assert sorted(pid for pids in before.values() for pid in pids) == ["g", "p1", "p2", "p3"]
    if faster:
        second.claim("p1", "stranger")
    for number in order:
        name = f"w{number}"
        (pid,) = before[name]
        stale = second.answer(name, second.sync_message(pid, name, epoch=1))
        follow(second, name, 1.0, workers[name].receive(1.0, stale))
        follow(second, name, 1.0, workers[name].tick(1.0))
    if not faster:
        assert working == before
    assert all(set(state.held) == working[name] for name, state in workers.items())
    held = [pid for pids in working.values() for pid in pids]
    assert len(held) == len(set(held)) == 4 - faster


def test_what_was_ended_here_is_claimed_anew() -> None:
    """Nobody refuses a learner that says nothing any more: without a claim its sub-task would be held for ever."""
    state = worker("p1", "g")
    for pid in ("p1", "g"):
        state.receive(0.1, granted(pid))
    assert of(SendClaim, state.tick(1.0)) == []
    state.forget("g", 1.0)
    assert [ask.claim.pid for ask in of(SendClaim, state.tick(1.1))] == ["g"]
    assert state.held == ["p1"]


def test_an_evaluator_that_lost_its_place_claims_it_again() -> None:
    state = worker(role="evaluator")
    state.receive(0.1, granted("evaluator", role="evaluator"))
    state.receive(5.0, Refused(reason="stale epoch", text="over", final=False))
    assert len(of(SendClaim, state.tick(5.1))) == 1


def test_a_goodbye_ends_the_worker_well() -> None:
    (end,) = of(Exit, worker("p1").receive(1.0, Goodbye(reason="solved")))
    assert end.code == 0
    assert "solved" in end.text


def stale(pid: str) -> Refused:
    return Refused(reason="stale epoch", text="x", final=False, pid=pid)


events = st.one_of(
    st.builds(lambda pid, epoch: granted(pid, epoch), st.sampled_from(["g", "p1", "p2"]), st.integers(1, 3)),
    st.builds(
        lambda pid, final: Refused(reason="stale epoch", text="x", final=final, pid=pid),
        st.sampled_from(["g", "p1", "p2", None]),
        st.booleans(),
    ),
    st.just(NOTHING_FREE),
    st.none(),
)


@settings(max_examples=80)
@given(pids=st.sampled_from([(), ("p1",), ("p1", "g")]), told=st.lists(events, max_size=15))
@example(
    pids=(),
    told=[granted("g"), *[NOTHING_FREE] * 4, None, granted("p2"), stale("g"), stale("p2")],
)
def test_nothing_is_held_twice_and_what_is_held_is_not_asked_for(pids: tuple[str, ...], told: list[Any]) -> None:
    state, working = worker(*pids), set[str]()
    for turn, message in enumerate(told):
        actions = state.tick(float(turn)) if message is None else state.receive(float(turn), message)
        assert len(state.held) == len(set(state.held))
        if pids:
            assert set(state.held) <= set(pids)
        for ask in of(SendClaim, actions):
            assert ask.claim.pid not in state.held
        working |= {begin.granted.pid for begin in of(StartWork, actions)}
        working -= {end.pid for end in of(StopWork, actions)}
        if isinstance(message, Refused) and message.final and message.pid:
            assert message.pid not in working
        assert set(state.held) <= working
        assert len(working) <= len(state._places)  # what is kept while it is asked for again is in its place
        if of(Exit, actions):
            return
