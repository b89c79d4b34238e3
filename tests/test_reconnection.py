"""What a broken connection or a worker started again means for leases: the coordinator as a pure state machine."""

from __future__ import annotations

from coordinator_events import Conversation, of

from coordinator.events import KeysChanged, LogEvent, LogRequest, Received, Send
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import Claim, Granted, LearnerStats, Message, Refused, Sync


def say(talk: Conversation, connection: bytes, message: Message, key: str = "") -> Message:
    """What the coordinator answers to a message over a connection."""
    actions = talk.state.handle(Received(talk.now, connection, Envelope(message, {}, "w", 5), key))
    (answer, *_) = of(Send, actions)
    return answer.message


def claim(pid: str | None, instance: str = "w") -> Claim:
    return Claim(role="learner", instance=instance, pid=pid)


def sync(epoch: int) -> Sync:
    return Sync(pid="g", epoch=epoch, sequence=0, version=0, start_cursor=0, stats=LearnerStats())


def test_a_learner_that_connects_anew_is_asked_to_claim_again_and_not_to_stop() -> None:
    talk = Conversation()
    granted = say(talk, b"first", claim("g"))
    assert isinstance(granted, Granted)
    refused = say(talk, b"second", sync(granted.epoch))
    assert isinstance(refused, Refused)
    assert (refused.reason, refused.final) == ("stale epoch", False)
    again = say(talk, b"second", claim("g"))
    assert isinstance(again, Granted)
    assert again.epoch == 2
    late = say(talk, b"first", sync(granted.epoch))
    assert isinstance(late, Refused)
    assert late.final


def test_a_worker_started_again_without_pid_gets_its_own_place_back() -> None:
    talk = Conversation()
    assert isinstance(say(talk, b"other", claim(None, "other")), Granted)
    held = say(talk, b"first", claim(None))
    assert isinstance(held, Granted)
    back = say(talk, b"second", claim(None))
    assert isinstance(back, Granted)
    assert (back.pid, back.epoch) == (held.pid, 2)
    share = say(talk, b"second", claim(None))  # the same process asks for a further one
    assert isinstance(share, Granted)
    assert share.pid not in (held.pid, "")


def test_a_place_is_given_back_only_to_the_key_that_held_it() -> None:
    talk = Conversation()
    held = say(talk, b"first", claim(None), "key")
    other = say(talk, b"second", claim(None), "another key")
    assert isinstance(held, Granted)
    assert isinstance(other, Granted)
    assert held.pid != other.pid


def test_leases_of_revoked_keys_end_and_others_stay() -> None:
    talk = Conversation()
    for pid, key in (("g", "gone"), ("p1", "kept"), ("p2", "")):
        say(talk, pid.encode(), claim(pid, pid), key)
    say(talk, b"evaluator", Claim(role="evaluator", instance="e"), "gone")
    told = of(LogEvent, talk.state.handle(KeysChanged(talk.now, {"kept"})))
    assert [line.text.split()[0] for line in told] == ["g", "evaluator"]
    assert [lease.place for lease in talk.state.leases.holders(talk.now)] == ["p1", "p2"]
    assert talk.state.evaluator_lease.holders(talk.now) == []
    assert of(LogEvent, talk.state.handle(KeysChanged(talk.now, {"kept"}))) == []
    assert isinstance(say(talk, b"heir", claim("g", "heir"), "kept"), Granted)


def test_notices_become_events() -> None:
    talk = Conversation()
    (told,) = talk.state.handle(LogRequest(3.0, "refused a client"))
    assert isinstance(told, LogEvent)
    assert talk.state.events[-1].text == "refused a client"
