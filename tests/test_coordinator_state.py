"""The coordinator's state machine by lists of events: leases, exactly-once progress, start states, evaluations."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from coordinator_events import Conversation, changes, of, starts, weights
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.events import Finish, Interrupted, LogEvent, Send
from t4nmtd_dist.wire.codec import Envelope, decode, encode
from t4nmtd_dist.wire.messages import (
    Failure,
    Goodbye,
    Granted,
    LearnerStats,
    Refused,
    Release,
    SyncReply,
)

ACCEPTING, ERROR = 5, 3


# Claims and leases


def test_every_subtask_is_given_once_and_then_workers_stand_by() -> None:
    talk = Conversation()
    pids = [talk.claim(None, f"w{i}").pid for i in range(4)]
    assert sorted(pids) == list(talk.state.task.decomposition.pids)
    refused = talk.refused(None, "w5")
    assert (refused.reason, refused.final) == ("nothing free", False)


def test_a_grant_brings_the_compiled_task() -> None:
    talk = Conversation()
    granted = talk.claim("g")
    assert granted.dfa == talk.state.task.dfa.to_json()
    assert granted.decomposition == talk.state.task.decomposition.to_json()
    assert granted.rho == list(talk.state.task.rho)
    assert (granted.epoch, granted.version) == (1, 0)


def test_an_unknown_pid_is_refused_with_the_known_ones() -> None:
    refused = Conversation().refused("p9", "w")
    assert (refused.reason, refused.final) == ("unknown pid", True)
    assert "g, p1, p2, p3" in refused.text


def test_a_live_lease_is_refused_until_it_expires() -> None:
    talk = Conversation(lease_s=10.0)
    talk.claim("g", "old")
    talk.now = 9.9
    refused = talk.refused("g", "new")
    assert (refused.reason, refused.final) == ("lease is live", True)
    assert "old" in refused.text
    talk.now = 10.1
    assert talk.claim("g", "new").epoch == 2


def test_a_heartbeat_keeps_a_lease() -> None:
    talk = Conversation(lease_s=10.0)
    talk.claim("g", "old")
    talk.now = 9.0
    talk.sync("g", "old")
    talk.now = 18.0
    assert talk.refused("g", "new").reason == "lease is live"


def test_the_same_instance_starts_a_new_epoch_and_counts_on() -> None:
    talk = Conversation()
    talk.claim("g", "w")
    talk.sync("g", "w", stats=LearnerStats(interactions=100))
    assert talk.claim("g", "w").epoch == 2
    talk.sync("g", "w", stats=LearnerStats(interactions=30))
    assert talk.state.interactions == 130


def test_what_crosses_a_new_grant_on_its_way_is_left_unanswered() -> None:
    talk = Conversation()
    talk.claim("g", "w")
    talk.claim("g", "w")
    assert talk.send("w", talk.sync_message("g", "w", epoch=1)) == []
    assert isinstance(talk.answer("w", talk.sync_message("g", "w", epoch=2)), SyncReply)


def test_the_old_holder_of_a_lease_taken_over_is_told_to_stop() -> None:
    talk = Conversation(lease_s=10.0)
    talk.claim("g", "old")
    talk.now = 11.0
    talk.claim("g", "new")
    refused = talk.answer("old", talk.sync_message("g", "old", epoch=1))
    assert isinstance(refused, Refused)
    assert (refused.reason, refused.final, refused.pid) == ("stale epoch", True, "g")
    assert talk.state.leases.live("g", talk.now)


def test_after_a_restart_a_lease_is_unknown_but_may_be_claimed_again() -> None:
    talk = Conversation()
    refused = talk.answer("w", talk.sync_message("g", "w", epoch=7))
    assert isinstance(refused, Refused)
    assert (refused.reason, refused.final) == ("stale epoch", False)
    assert talk.claim("g", "w").epoch == 1


def test_a_sync_for_an_unknown_pid_is_refused() -> None:
    assert isinstance(Conversation().answer("w", Conversation().sync_message("p9", "w", epoch=1)), Refused)


def test_a_lease_given_back_is_free_at_once_and_not_called_lost() -> None:
    talk = Conversation(lease_s=10.0)
    epoch = talk.claim("g", "old").epoch
    talk.send("old", Release(pid="g", epoch=epoch))
    assert talk.claim("g", "new").epoch == 2
    talk.send("new", Release(pid="g", epoch=2))
    talk.now = 100.0
    assert of(LogEvent, talk.tick()) == []


def test_only_the_holder_can_give_a_lease_back() -> None:
    talk = Conversation()
    epoch = talk.claim("g", "holder").epoch
    talk.send("other", Release(pid="g", epoch=epoch))
    talk.send("holder", Release(pid="g", epoch=epoch - 1))
    assert talk.state.leases.live("g", talk.now)


def test_a_silent_learner_is_called_lost_once() -> None:
    talk = Conversation(lease_s=10.0)
    talk.claim("g", "w")
    talk.now = 9.0
    assert talk.tick() == []
    talk.now = 11.0
    (told,) = of(LogEvent, talk.tick())
    assert "g lost" in told.text
    assert talk.tick() == []


def test_new_weights_go_to_the_next_holder() -> None:
    talk = Conversation(lease_s=10.0)
    talk.claim("g", "old")
    talk.sync("g", "old", version=4, arrays=weights(7.0))
    talk.now = 11.0
    actions = talk.send("new", talk.claim_message("g", "new"))
    sent = next(action for action in of(Send, actions) if isinstance(action.message, Granted))
    assert isinstance(sent.message, Granted)
    assert sent.message.version == 4
    assert sent.arrays.keys() == weights().keys()
    assert all((array == 7.0).all() for array in sent.arrays.values())


# Progress


@settings(max_examples=30)
@given(repeats=st.integers(1, 4), rows=st.lists(st.tuples(st.integers(0, 4), st.integers(-1, 5)), max_size=6))
def test_repeated_progress_changes_nothing(repeats: int, rows: list[tuple[int, int]]) -> None:
    arrays = changes(*[(q, q_next, 3, 1.0) for q, q_next in rows]) | starts((1, 7), (2, 8))
    talk = Conversation()
    talk.claim("p1", "w")
    talk.sync("p1", "w", sequence=1, arrays=arrays)
    before = talk.fingerprint()
    for _ in range(repeats):
        reply = talk.sync("p1", "w", sequence=1, arrays=arrays)
        assert reply.accepted_sequence == 1
    assert talk.fingerprint() == before
    talk.sync("p1", "w", sequence=2, arrays=starts((1, 9)))
    assert talk.fingerprint() != before


def test_an_old_repeat_does_not_turn_the_counters_back() -> None:
    talk = Conversation()
    talk.claim("p1", "w")
    talk.sync("p1", "w", sequence=1, stats=LearnerStats(interactions=10))
    talk.sync("p1", "w", sequence=2, stats=LearnerStats(interactions=20))
    talk.sync("p1", "w", sequence=1, stats=LearnerStats(interactions=10))
    assert talk.state.interactions == 20


def test_changes_teach_the_q_table_and_failures_lower_it() -> None:
    talk = Conversation()
    talk.claim("p1", "w")
    talk.sync("p1", "w", arrays=changes((0, 1, 5, 10.0)))
    first = talk.state.method.q_table.value(0, "p1")
    assert first == pytest.approx(10.0)
    talk.sync("p1", "w", sequence=2, arrays=changes((0, -1, 300, 0.0)))
    assert 0 < talk.state.method.q_table.value(0, "p1") < first


def test_start_states_are_sent_once() -> None:
    """Trap: start states re-sent for ever."""
    talk = Conversation()
    talk.claim("p1", "w")
    talk.claim("g", "v")
    cursor, seen = 0, []
    for sequence in range(1, 5):
        talk.sync("p1", "w", sequence=sequence, arrays=starts((1, sequence), (1, 0)))
        reply, arrays = talk.sync_with_arrays("g", "v", sequence=sequence, cursor=cursor)
        seen += arrays["starts.state"][:, 0].tolist() if arrays else []
        cursor = reply.start_cursor
    assert len(seen) == len(set(seen))
    _, arrays = talk.sync_with_arrays("g", "v", sequence=9, cursor=cursor)
    assert arrays == {}
    everything, _ = zip(*[(state[0], q) for _, q, state in talk.state.records["g"].buffer.since(0, 100)], strict=True)
    assert sorted(seen) == sorted(everything)


def test_a_learner_behind_is_served_in_bounded_portions() -> None:
    talk = Conversation()
    talk.claim("p1", "w")
    talk.claim("g", "v")
    for n in range(700):
        talk.state.records["g"].buffer.add((1, 2, 4)[n % 3], np.array([n, 0]))
    cursor, total, portions = 0, 0, 0
    while True:
        reply, arrays = talk.sync_with_arrays("g", "v", sequence=portions + 1, cursor=cursor)
        if not arrays:
            break
        cursor, total, portions = reply.start_cursor, total + len(arrays["starts.q"]), portions + 1
    assert total == len(talk.state.records["g"].buffer)
    assert portions > 1


@pytest.mark.slow
def test_great_start_states_are_served_in_portions_that_a_message_can_hold() -> None:
    talk = Conversation()
    talk.claim("p1", "w")
    talk.claim("g", "v")
    great = np.zeros(1_000_000)
    talk.sync("p1", "w", arrays={"starts.q": np.zeros(1, np.int32), "starts.state": great[None]})
    for n in range(40):
        talk.state.records["g"].buffer.add((1, 2, 4)[n % 3], np.full_like(great, n))
    cursor, seen = 0, 0
    while seen < len(talk.state.records["g"].buffer):
        reply, arrays = talk.sync_with_arrays("g", "v", sequence=seen + 1, cursor=cursor)
        assert len(decode(encode(Envelope(reply, arrays))).arrays["starts.q"]) > 0
        cursor, seen = reply.start_cursor, seen + len(arrays["starts.q"])


@pytest.mark.parametrize("q", [ACCEPTING, ERROR])
def test_accepting_and_error_states_never_reach_a_buffer(q: int) -> None:
    talk = Conversation()
    talk.claim("p1", "w")
    talk.sync("p1", "w", arrays=starts((q, 1)))
    assert all(len(record.buffer) == 0 for record in talk.state.records.values())


def test_a_start_state_goes_to_a_subtask_available_there() -> None:
    talk = Conversation("high_level.epsilon=1.0")
    talk.claim("p1", "w")
    talk.sync("p1", "w", arrays=starts(*[(1, n) for n in range(60)]))
    holding = {pid for pid, record in talk.state.records.items() if len(record.buffer)}
    assert holding == set(talk.state.task.decomposition.available(1))


MALFORMED = {
    "no such state": changes((0, 6, 1, 0.0)),
    "q is -1": changes((-1, 1, 1, 0.0)),
    "negative steps": changes((0, 1, -5, 0.0)),
    "reward is nan": changes((0, 1, 1, float("nan"))),
    "reward is infinite": changes((0, 1, 1, float("inf"))),
    "lengths differ": changes((0, 1, 1, 0.0)) | {"progress.reward": np.zeros(2)},
    "q is no matrix": {"progress.q": np.zeros(3, np.int32)},
    "q is a float": {"progress.q": np.zeros((1, 3)), "progress.reward": np.zeros(1)},
    "start without state": {"starts.q": np.zeros(1, np.int32)},
    "starts.q a scalar": starts((1, 1)) | {"starts.q": np.int32(1)},
    "start outside": starts((6, 1)),
    "a start of another size": {"starts.q": np.zeros(1, np.int32), "starts.state": np.zeros((1, 5), np.int64)},
    "a start of another type": {"starts.q": np.zeros(1, np.int32), "starts.state": np.zeros((1, 2), np.float32)},
}


@pytest.mark.parametrize("arrays", MALFORMED.values(), ids=MALFORMED.keys())
def test_malformed_progress_is_answered_and_changes_nothing(arrays: dict[str, Any]) -> None:
    talk = Conversation("high_level.smdp_discount=true")
    for pid in talk.state.task.decomposition.pids:
        talk.claim(pid, pid)
    talk.sync("p1", "p1", arrays=starts((1, 1)))
    before = talk.fingerprint()
    arrays = {name: np.asarray(array) for name, array in arrays.items()}
    assert isinstance(talk.answer("p1", talk.sync_message("p1", "p1", sequence=2), arrays), Failure)
    assert talk.fingerprint() == before
    for pid in talk.state.task.decomposition.pids:
        talk.sync(pid, pid, sequence=3, arrays=starts((1, 2), (2, 3), (4, 4)))


# The end


def test_the_run_ends_when_the_budget_is_spent() -> None:
    talk = Conversation(max_interactions=100)
    talk.claim("p1", "w")
    talk.claim("g", "v")
    talk.sync("p1", "w", stats=LearnerStats(interactions=60))
    assert talk.state.outcome is None
    actions = talk.send("v", talk.sync_message("g", "v", stats=LearnerStats(interactions=40)))
    assert [finish.outcome for finish in of(Finish, actions)] == ["budget spent"]
    told = {send.peer for send in of(Send, actions) if isinstance(send.message, Goodbye)}
    assert told == {b"w", b"v"}
    assert talk.answer("late", talk.claim_message("p2", "late")) == Goodbye(reason="budget spent")
    assert talk.state.outcome == "budget spent"


def test_an_interruption_ends_the_run_once() -> None:
    talk = Conversation()
    assert len(of(Finish, talk.state.handle(Interrupted(talk.now, "asked")))) == 1
    assert of(Finish, talk.state.handle(Interrupted(talk.now, "asked"))) == []
