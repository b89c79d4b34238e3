"""Policy intervention over real sockets: values as the peer's network gives them, and nothing stalls without it."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import zmq
from numpy.typing import NDArray
from routers import receive_from
from small_tasks import CARRYING_2, START, small_learner

from t4nmtd_dist.agents.common.peer_values import NoPeers, PeerValues, Questions
from t4nmtd_dist.agents.ppo.agent import PATIENCE_S, PPOLearner
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import Failure, Message, Peer, Release, ValueReply, ValueRequest
from t4nmtd_dist.wire.peers.critic_client import QueryPeers
from t4nmtd_dist.wire.sockets import bind, bound_endpoint, connect, receive, send
from t4nmtd_dist.wire.zmq_types import Context, Socket
from workers.critic_service import CriticService

WAIT_S = 10.0
ALLOWANCE_S = 3.0  # a slow machine's, on top of the patience of who gathers
NUMBERS = itertools.count()

Question = tuple[int, str, NDArray[np.float32], int]
ONE: Question = (0, "g", np.zeros(3, np.float32), 0)


@pytest.fixture
def peers(context: Context) -> Iterator[QueryPeers]:
    made = QueryPeers(context, "asker")
    yield made
    made.close()


def at(endpoint: str, version: int = 0) -> Peer:
    return Peer(endpoint=endpoint, version=version, epoch=1)


def observations(learner: PPOLearner, count: int) -> NDArray[np.float32]:
    size = learner.rollout.observations.shape[1]
    return np.random.default_rng(0).uniform(-1, 1, (count, size)).astype(np.float32)


def gathered(peers: QueryPeers, questions: list[Question], patience_s: float = PATIENCE_S) -> PeerValues:
    """Ask about a batch of (row, pid, observation, q), and gather it at once."""
    batch = next(NUMBERS)
    rows, pids, seen, q = zip(*questions, strict=True)
    peers.ask(batch, Questions(np.array(rows), pids, np.stack(seen), np.array(q, np.int32)))
    return peers.gather(batch, patience_s)


def answered(peers: QueryPeers, questions: list[Question]) -> dict[int, float]:
    """Ask again until every question is answered: the first tries may come before the connection stands."""
    deadline = time.monotonic() + WAIT_S
    while time.monotonic() < deadline:
        found = gathered(peers, questions)
        if len(found.rows) == len(questions):
            return dict(zip(found.rows.tolist(), found.values.tolist(), strict=True))
    raise AssertionError("no complete answer within the deadline")


def test_the_values_are_those_of_the_published_network(service: CriticService, peers: QueryPeers) -> None:
    learners = {pid: small_learner(pid) for pid in ("g", "p1")}
    for pid, learner in learners.items():
        learner.rollout.begin()
        service.serve(pid, learner.published)
    peers.set_peers({pid: at(service.endpoint) for pid in learners})
    rows = observations(learners["g"], 150)
    q = [CARRYING_2 if i % 3 else START for i in range(150)]
    questions = [(i, "g" if i % 2 else "p1", rows[i], q[i]) for i in range(150)]
    found = answered(peers, questions)
    for i, pid, observation, state in questions:
        expected = learners[pid].critic_values(observation[None], np.array([state], np.int32))[0]
        assert found[i] == pytest.approx(expected, abs=1e-6)
    assert peers.counts.asked == peers.counts.answered + peers.counts.own_used


def test_the_lag_is_counted_in_versions(service: CriticService, peers: QueryPeers) -> None:
    learner = small_learner("p2")
    learner.iterate(NoPeers())
    service.serve("p2", learner.published)
    peers.set_peers({"p2": at(service.endpoint, version=4)})
    answered(peers, [(0, "p2", observations(learner, 1)[0], START)])
    assert peers.counts.lag_total == 3 * peers.counts.answered


@pytest.mark.parametrize("endpoint", ["tcp://127.0.0.1:1", "not an endpoint", "tcp://*:5"])
def test_a_peer_that_is_away_costs_one_deadline_at_most(peers: QueryPeers, endpoint: str) -> None:
    peers.set_peers({"g": at(endpoint)})
    began = time.monotonic()
    questions = [(row, "g", np.zeros(3, np.float32), 0) for row in range(100)]
    found = gathered(peers, [*questions, (100, "unknown", np.zeros(3, np.float32), 0)])
    assert len(found.rows) == 0
    assert time.monotonic() - began < PATIENCE_S + ALLOWANCE_S
    counts = peers.counts
    assert (counts.asked, counts.answered, counts.own_used, counts.late) == (101, 0, 101, 0)


def test_a_silent_peer_is_not_waited_for_again_and_again(context: Context, peers: QueryPeers) -> None:
    silent = bind(context, zmq.ROUTER, "tcp://127.0.0.1:*")
    peers.set_peers({"g": at(bound_endpoint(silent))})
    deadline = time.monotonic() + WAIT_S
    while not silent.poll(10):  # the connection stands once a question arrives
        assert time.monotonic() < deadline
        gathered(peers, [ONE])
    for _ in range(4):
        gathered(peers, [ONE])
    began = time.monotonic()
    for _ in range(50):
        gathered(peers, [ONE])
    assert time.monotonic() - began < 50 * PATIENCE_S / 2


def test_a_peer_that_answers_again_after_a_silence_is_waited_for_again(context: Context, peers: QueryPeers) -> None:
    """Few rows are asked for only when they are gathered, so without a wait their answers would be late for ever."""
    router = bind(context, zmq.ROUTER, "tcp://127.0.0.1:*")
    peers.set_peers({"g": at(bound_endpoint(router))})
    deadline = time.monotonic() + WAIT_S
    while not router.poll(10):
        assert time.monotonic() < deadline
        gathered(peers, [ONE])
    for _ in range(4):
        gathered(peers, [ONE])
    over = threading.Event()
    helper = threading.Thread(target=answer_all, args=(router, over), daemon=True)
    helper.start()
    found = 0
    try:
        while not found:
            assert time.monotonic() < deadline, "the peer answers, but nobody waits for it"
            found = len(gathered(peers, [ONE]).rows)
            over.wait(0.05)  # a roll-out takes its time
    finally:
        over.set()
        helper.join(WAIT_S)


def answer_all(router: Socket, over: threading.Event) -> None:
    """Answer every request with a zero, older ones first and each after a moment's work, until told to stop."""
    while not over.wait(0.01):
        if router.poll(20):
            received = receive_from(router)
            assert received is not None
            peer, envelope = received
            assert isinstance(envelope, Envelope)
            send(router, Envelope(ValueReply(version=0), {"value": np.zeros(1, np.float32)}, id=envelope.id), peer=peer)


def test_late_and_malformed_answers_change_nothing(context: Context, peers: QueryPeers) -> None:
    liar = bind(context, zmq.ROUTER, "tcp://127.0.0.1:*")
    peers.set_peers({"g": at(bound_endpoint(liar))})
    deadline = time.monotonic() + WAIT_S
    while not liar.poll(10):
        assert time.monotonic() < deadline
        gathered(peers, [ONE])
    asker, *_ = liar.recv_multipart()
    answers: list[tuple[Message, dict[str, NDArray[Any]]]] = [
        (ValueReply(version=1), {"value": np.full(1, 7.0, np.float32)}),
        (Failure(text="no"), {}),
    ]
    for message, arrays in answers:
        send(liar, Envelope(message, arrays, id=1), peer=asker)
    liar.send_multipart([asker, b"nonsense"])
    while peers.counts.late < 2:
        assert time.monotonic() < deadline
        assert len(gathered(peers, [ONE]).rows) == 0


WRONG = {
    "not finite": np.full(1, np.nan, np.float32),
    "too many": np.zeros(2, np.float32),
    "of another type": np.zeros(1, np.float64),
}


@pytest.mark.slow
@pytest.mark.parametrize("value", WRONG.values(), ids=WRONG.keys())
def test_wrong_values_fall_back_to_the_own_critic(context: Context, peers: QueryPeers, value: NDArray[Any]) -> None:
    liar = bind(context, zmq.ROUTER, "tcp://127.0.0.1:*")
    peers.set_peers({"g": at(bound_endpoint(liar))})
    deadline = time.monotonic() + WAIT_S
    while not liar.poll(10):
        assert time.monotonic() < deadline
        gathered(peers, [ONE])
    asker, *_ = liar.recv_multipart()
    for number in range(1, 2000):  # every question still to come is answered wrongly, in advance
        send(liar, Envelope(ValueReply(version=1), {"value": value}, id=number), peer=asker)
    assert len(gathered(peers, [ONE]).rows) == 0
    assert peers.counts.answered == 0


BAD_REQUESTS: dict[str, tuple[Message, dict[str, NDArray[Any]]]] = {
    "another message": (Release(pid="g", epoch=1), {}),
    "unknown pid": (ValueRequest(pid="p9"), {}),
    "no arrays": (ValueRequest(pid="g"), {}),
    "another width": (ValueRequest(pid="g"), {"observation": np.zeros((1, 3), np.float32), "q": np.zeros(1, np.int32)}),
    "no such state": (
        ValueRequest(pid="g"),
        {"observation": np.zeros((1, 83), np.float32), "q": np.full(1, 6, np.int32)},
    ),
    "q of floats": (ValueRequest(pid="g"), {"observation": np.zeros((1, 83), np.float32), "q": np.zeros(1)}),
    "q a number": (ValueRequest(pid="g"), {"observation": np.zeros((1, 83), np.float32), "q": np.int32(0)}),
    "q a column": (
        ValueRequest(pid="g"),
        {"observation": np.zeros((2, 83), np.float32), "q": np.zeros((2, 1), np.int32)},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize(("request_", "arrays"), BAD_REQUESTS.values(), ids=BAD_REQUESTS.keys())
def test_bad_requests_are_answered_and_the_service_goes_on(
    context: Context, service: CriticService, request_: Message, arrays: dict[str, NDArray[Any]]
) -> None:
    learner = small_learner("g")
    service.serve("g", learner.published)
    socket = connect(context, service.endpoint)
    assert socket.poll(int(WAIT_S * 1000), zmq.POLLOUT)
    arrays = {name: np.asarray(array) for name, array in arrays.items()}
    assert send(socket, Envelope(request_, arrays, id=5))
    reply = receive(socket, WAIT_S)
    assert reply is not None
    assert (type(reply.message), reply.id) == (Failure, 5)
    rows = observations(learner, 2)
    assert send(socket, Envelope(ValueRequest(pid="g"), {"observation": rows, "q": np.zeros(2, np.int32)}, id=6))
    good = receive(socket, WAIT_S)
    assert good is not None
    assert good.arrays["value"] == pytest.approx(learner.critic_values(rows, np.zeros(2, np.int32)), abs=1e-6)
