"""Answers numbered for the stand-in come from the same coordinator: they get past no check, and end no learner."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from coordinator_events import Conversation
from strangers import Stranger
from test_stand_in import Alone, Slices

from t4nmtd_dist.core.errors import TrustError
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import Claim, EvaluationPoll, Failure, Granted, Message, Release
from workers.options import Connection, WorkerOptions
from workers.stand_in import STAND_IN, StandIn
from workers.worker import Worker


@pytest.fixture
def worker() -> Iterator[Worker]:
    made = Worker(WorkerOptions(Connection("tcp://127.0.0.1:9"), "learner", ["p1"], "p1"))
    try:
        yield made
    finally:
        made._close()


def granted() -> Granted:
    return Alone().claim_evaluator("p1")


@pytest.mark.parametrize("invited", [False, True])
def test_an_evaluators_lease_runs_no_code_of_a_coordinator_that_is_not_trusted(
    invited: bool, worker: Worker, tmp_path: Path
) -> None:
    stranger = Stranger(tmp_path)
    lease = granted()
    planted = {**lease.task["environment"], **stranger.attacks()["a module of their own"]}
    lease = msgspec.structs.replace(lease, task={**lease.task, "environment": planted})
    if invited:
        worker._stand_in.invited()
    with pytest.raises(TrustError, match="planted:Corridor"):
        worker._take(Envelope(lease, {}, "", STAND_IN), 0.0)
    assert not stranger.mark.exists()


def test_a_lease_that_was_not_asked_for_begins_nothing() -> None:
    session, sent = Slices(1, 0.0), list[Message]()
    stand_in = StandIn("p1", sent.append, lambda text: None, lambda: 0.0, session.open)
    talk: Conversation = Alone()
    lease = Envelope(talk.claim_evaluator("p1"), {}, "", STAND_IN)
    stand_in.take(lease)
    stand_in.tell()
    assert sent == []
    stand_in.invited()
    stand_in.take(lease)
    stand_in.tell()
    assert [type(message) for message in sent] == [Claim, EvaluationPoll]


def test_a_failure_ends_the_stand_ins_work_and_not_the_learner(
    worker: Worker, capsys: pytest.CaptureFixture[str]
) -> None:
    worker._stand_in.invited()
    worker._take(Envelope(granted(), {}, "", STAND_IN), 0.0)
    worker._take(Envelope(Failure(text="the message is too large"), {}, "", STAND_IN), 0.0)
    assert worker._exit is None
    assert "does not evaluate any more: the coordinator refused a message: the message is too large" in (
        capsys.readouterr().err
    )
    worker._take(Envelope(Failure(text="the message is too large"), {}, "", 0), 0.0)
    assert worker._exit is not None


def test_a_failure_gives_the_place_back() -> None:
    session, sent = Slices(1, 0.0), list[Message]()
    stand_in = StandIn("p1", sent.append, lambda text: None, lambda: 0.0, session.open)
    stand_in.invited()
    stand_in.take(Envelope(granted(), {}, "", STAND_IN))
    stand_in.take(Envelope(Failure(text="no"), {}, "", STAND_IN))
    stand_in.invited()
    assert [type(message) for message in sent] == [Claim, Release]
