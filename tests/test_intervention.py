"""Policy intervention behind one interface: numbered batches, replicas, peers in the same process, and mixtures."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import zmq
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from routers import receive_from
from small_sac import PIDS, START, TO_G2, TO_G3, small_sac
from small_tasks import small_learner

from t4nmtd_dist.agents.common.off_policy import OffPolicyLearner
from t4nmtd_dist.agents.common.peer_values import LocalPeers, MixedPeers, NoPeers, PeerCritics, PeerValues, Questions
from t4nmtd_dist.agents.ppo.agent import PPOLearner
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import (
    Failure,
    Message,
    Peer,
    ValueReply,
    ValueRequest,
    WeightsReply,
    WeightsRequest,
)
from t4nmtd_dist.wire.peers.critic_client import GATHERINGS_PER_REQUEST, ROWS_PER_REQUEST, QueryPeers
from t4nmtd_dist.wire.peers.replica import FIRST_PULL_EVERY_S, PULL_EVERY_S, ReplicaPeers
from t4nmtd_dist.wire.sockets import bind, bound_endpoint, connect, receive, send
from t4nmtd_dist.wire.zmq_types import Context, Socket, new_context
from workers.critic_service import WEIGHTS_EVERY_S, CriticService

WAIT_S = 20.0
NEVER = -1  # a number that no batch has: gathering it lets time pass

Floats = NDArray[np.float32]


def at(endpoint: str, version: int = 0, epoch: int = 1) -> Peer:
    return Peer(endpoint=endpoint, version=version, epoch=epoch)


def questions(rows: list[int], pid: str | tuple[str, ...], observations: Floats, q: int = 0) -> Questions:
    pids = (pid,) * len(rows) if isinstance(pid, str) else pid
    return Questions(np.array(rows, np.int64), pids, observations, np.full(len(rows), q, np.int32))


def stand(peers: QueryPeers | ReplicaPeers) -> None:
    """Wait until the connections stand."""
    for line in peers._connections.by_pid.values():
        assert line.socket.poll(int(WAIT_S * 1000), zmq.POLLOUT)


def soon(found: Callable[[], Any]) -> Any:
    deadline = time.monotonic() + WAIT_S
    while not (result := found()):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return result


# Numbered batches


class Answerer:
    """A peer whose answers the test decides; the value of an observation is its first number."""

    def __init__(self, context: Context) -> None:
        self.socket: Socket = bind(context, zmq.ROUTER, "tcp://127.0.0.1:*")
        self.endpoint = bound_endpoint(self.socket)

    def requests(self, rows: int) -> list[tuple[bytes, Envelope]]:
        """The next requests, as many as have so many rows together."""
        found: list[tuple[bytes, Envelope]] = []
        while rows > 0:
            assert self.socket.poll(int(WAIT_S * 1000))
            received = receive_from(self.socket)
            assert received is not None
            peer, envelope = received
            assert isinstance(envelope, Envelope)
            found.append((peer, envelope))
            rows -= len(envelope.arrays["q"])
        return found

    def answer(self, peer: bytes, request: Envelope, version: int = 0) -> None:
        value = request.arrays["observation"][:, 0].copy()
        send(self.socket, Envelope(ValueReply(version=version), {"value": value}, id=request.id), peer=peer)


batches = st.lists(st.tuples(st.integers(1, 6), st.integers(0, GATHERINGS_PER_REQUEST)), min_size=1, max_size=12)


@settings(max_examples=25, deadline=None)
@given(sizes=batches, data=st.data())
def test_answers_belong_to_their_batch_and_row_whatever_the_order(
    sizes: list[tuple[int, int]], data: st.DataObject
) -> None:
    """Some requests are never answered; the others in any order. Batches are gathered in any order, too."""
    context = new_context()
    answerer, peers = Answerer(context), QueryPeers(context, "asker")
    try:
        peers.set_peers({"g": at(answerer.endpoint)})
        stand(peers)
        expected: dict[int, dict[int, float]] = {}
        for batch, (size, passing) in enumerate(sizes):
            rows = data.draw(st.permutations(range(size)))
            values = np.array([[1000 * batch + row] for row in rows], np.float32)
            expected[batch] = dict(zip(rows, values[:, 0].tolist(), strict=True))
            peers.ask(batch, questions(rows, "g", values))
            for _ in range(passing):
                peers.gather(NEVER)
        last = len(sizes)
        for _ in range(GATHERINGS_PER_REQUEST):
            peers.gather(NEVER)
        requests = answerer.requests(sum(size for size, _ in sizes))
        peers.ask(last, questions([0], "g", np.zeros((1, 1), np.float32)))
        for _ in range(GATHERINGS_PER_REQUEST):
            peers.gather(NEVER)
        kept = [request for request in requests if data.draw(st.booleans())]
        for peer, request in [*data.draw(st.permutations(kept)), *answerer.requests(1)]:
            answerer.answer(peer, request)
        assert len(peers.gather(last, WAIT_S).rows) == 1, "the last answer: all others have come before it"
        heard = {int(value) for _, request in kept for value in request.arrays["observation"][:, 0]}
        for batch in data.draw(st.permutations(range(last))):
            found = peers.gather(batch)
            answers = dict(zip(found.rows.tolist(), found.values.tolist(), strict=True))
            assert answers == {row: value for row, value in expected[batch].items() if int(value) in heard}
            assert len(peers.gather(batch).rows) == 0, "once only"
        total, answered = sum(size for size, _ in sizes) + 1, len(heard) + 1
        counts = peers.counts
        assert (counts.asked, counts.answered) == (total, answered)
        assert counts.late == counts.own_used == total - answered
    finally:
        peers.close()
        answerer.socket.close(0)
        context.destroy(linger=0)


def test_neighbouring_batches_share_a_request_and_large_ones_have_their_own(context: Context) -> None:
    answerer, peers = Answerer(context), QueryPeers(context, "asker")
    peers.set_peers({"g": at(answerer.endpoint)})
    stand(peers)
    for batch in range(4):
        peers.ask(batch, questions([0, 1], "g", np.zeros((2, 1), np.float32)))
    peers.gather(0)
    assert [len(request.arrays["q"]) for _, request in answerer.requests(8)] == [8]
    rows = list(range(ROWS_PER_REQUEST))
    peers.ask(4, questions(rows, "g", np.zeros((len(rows), 1), np.float32)))
    assert [len(request.arrays["q"]) for _, request in answerer.requests(len(rows))] == [len(rows)]
    peers.close()


def test_a_late_answer_changes_nothing_and_its_rows_are_counted_late(context: Context) -> None:
    answerer, peers = Answerer(context), QueryPeers(context, "asker")
    peers.set_peers({"g": at(answerer.endpoint), "away": at("tcp://127.0.0.1:1")})
    stand_on(peers, "g")
    peers.ask(0, questions([0, 1, 2], ("g", "away", "unknown"), np.ones((3, 1), np.float32)))
    assert len(peers.gather(0).rows) == 0
    assert (peers.counts.asked, peers.counts.late, peers.counts.own_used) == (3, 1, 3)
    for peer, request in answerer.requests(1):
        answerer.answer(peer, request)
    peers.ask(1, questions([0], "g", np.full((1, 1), 7.0, np.float32)))
    for _ in range(GATHERINGS_PER_REQUEST):
        peers.gather(NEVER)
    for peer, request in answerer.requests(1):
        answerer.answer(peer, request, version=3)
    found = peers.gather(1, WAIT_S)
    assert (found.rows.tolist(), found.values.tolist()) == ([0], [7.0])
    assert (peers.counts.answered, peers.counts.late, peers.counts.own_used) == (1, 1, 3)
    peers.close()


def stand_on(peers: QueryPeers, pid: str) -> None:
    assert peers._connections.by_pid[pid].socket.poll(int(WAIT_S * 1000), zmq.POLLOUT)


def crossing(learner: OffPolicyLearner, peers: PeerCritics) -> None:
    """Training with rows across a boundary in every batch."""
    if len(learner.replay_buffer) < 60:
        for _ in range(3):
            learner.iterate(NoPeers())
    read = learner.replay_buffer.returns

    def everything_crosses(*arguments: Any) -> Any:
        found = read(*arguments)
        found.boundary[:] = found.q_next == START
        found.q_next[found.boundary] = TO_G2
        return found

    learner.replay_buffer.returns = everything_crosses  # type: ignore[method-assign]
    learner._ahead.drawn.clear()
    for _ in range(40):
        learner._train(peers)


def test_a_silent_peer_never_stalls_the_training(context: Context) -> None:
    silent, peers = Answerer(context), QueryPeers(context, "asker", value_shape=(2,))
    peers.set_peers({"g2": at(silent.endpoint)})
    stand(peers)
    spent, gather = [], peers.gather

    def timed(batch: int, patience_s: float = 0.0) -> PeerValues:
        began = time.perf_counter()
        found = gather(batch, patience_s)
        spent.append(time.perf_counter() - began)
        return found

    peers.gather = timed  # type: ignore[method-assign]
    learner = small_sac("g1")
    crossing(learner, peers)
    assert len(spent) == 40
    assert np.median(spent) < 0.005
    assert silent.requests(1), "it was asked"
    counts = peers.counts
    assert counts.answered == 0
    assert 0 < counts.late <= counts.own_used <= counts.asked
    peers.close()


def test_a_peer_that_answers_is_trained_with(context: Context, service: CriticService) -> None:
    peer, peers = small_sac("g2", seed=1), QueryPeers(context, "asker", value_shape=(2,))
    service.serve("g2", peer.published)
    peers.set_peers({"g2": at(service.endpoint)})
    stand(peers)
    patient = peers.gather
    peers.gather = lambda batch, patience_s=0.0: patient(batch, WAIT_S)  # type: ignore[method-assign]
    learner = small_sac("g1")
    crossing(learner, peers)
    counts, ahead = peers.counts, sum(len(drawn.asked_rows) for drawn in learner._ahead.drawn)
    assert counts.answered > 200
    assert (counts.answered, counts.late, counts.own_used) == (counts.asked - ahead, 0, 0)
    peers.close()


# Replicas


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def seen(learner: OffPolicyLearner | PPOLearner, count: int = 9) -> Floats:
    size = learner.rollout.observations.shape[1]
    return np.random.default_rng(0).uniform(-1, 1, (count, size)).astype(np.float32)


def pulled(peers: ReplicaPeers, pid: str, clock: Clock, observations: Floats) -> PeerValues:
    """Ask about a batch until its rows are answered."""
    batch = iter(range(10**6))

    def found() -> PeerValues | None:
        clock.now += FIRST_PULL_EVERY_S
        number = next(batch)
        peers.ask(number, questions(list(range(len(observations))), pid, observations, START))
        answers = peers.gather(number)
        return answers if len(answers.rows) else None

    result: PeerValues = soon(found)
    return result


@pytest.mark.parametrize("algorithm", ["sac", "ppo"])
def test_a_replica_is_the_peers_network_at_its_version(
    context: Context, service: CriticService, algorithm: str
) -> None:
    learner: OffPolicyLearner | PPOLearner = small_sac("g1") if algorithm == "sac" else small_learner("p2")
    for _ in range(4):
        learner.iterate(NoPeers())
    service.serve("x", learner.published)
    clock, made = Clock(), learner.replica()
    peers = ReplicaPeers(context, "asker", lambda: made, clock=clock)
    peers.set_peers({"x": at(service.endpoint, version=learner.version)})
    stand(peers)
    observations, q = seen(learner), np.full(9, START, np.int32)
    answers = pulled(peers, "x", clock, observations)
    arrays = {"observation": observations, "q": q}
    assert made.values(arrays)[1] == learner.version == 4
    if isinstance(learner, OffPolicyLearner):  # the drawn actions are the copy's own: draw the same
        noise = learner.published._critic.generator.get_state()  # type: ignore[attr-defined]
        made._critic.generator.set_state(noise)  # type: ignore[attr-defined]
        expected = learner.published.values(arrays)[0]
        learner.published._critic.generator.set_state(noise)  # type: ignore[attr-defined]
    else:
        expected = learner.published.values(arrays)[0]
    assert made.values(arrays)[0] == pytest.approx(expected, abs=1e-6)
    assert answers.rows.tolist() == list(range(9))
    assert answers.values.shape == expected.shape
    assert peers.counts.lag_total == 0
    peers.close()


def test_a_replica_is_pulled_again_when_there_is_a_newer_version_and_not_too_often(context: Context) -> None:
    learner, clock = small_sac("g1"), Clock()
    router = bind(context, zmq.ROUTER, "tcp://127.0.0.1:*")
    peers = ReplicaPeers(context, "asker", learner.replica, clock=clock)

    def tell(version: int, epoch: int = 1) -> None:
        peers.set_peers({"g1": at(bound_endpoint(router), version, epoch)})

    def gathered() -> PeerValues:
        peers.ask(0, questions([5], "g1", seen(learner, 1)))
        return peers.gather(0)

    def request() -> WeightsRequest | None:
        gathered()
        if not router.poll(100):
            return None
        received = receive_from(router)
        assert received is not None
        peer, envelope = received
        assert isinstance(envelope, Envelope)
        assert isinstance(envelope.message, WeightsRequest)
        weights, _ = learner.published.weights()
        arrays = {f"weights.{name}": array for name, array in weights.items()}
        send(router, Envelope(WeightsReply(version=learner.version), arrays, id=envelope.id), peer=peer)
        return envelope.message

    tell(0)
    stand(peers)
    assert request() == WeightsRequest(pid="g1", newer_than=-1)
    assert soon(lambda: len(gathered().rows)) == 1
    clock.now += PULL_EVERY_S
    assert request() is None, "nothing newer is known"
    tell(3)
    assert request() is None, "too soon"
    lag = peers.counts.lag_total
    gathered()
    assert peers.counts.lag_total == lag + 3
    learner.version = 3
    learner.published.update(learner.agent.critic_weights(), 3)
    clock.now += PULL_EVERY_S
    assert request() == WeightsRequest(pid="g1", newer_than=0)
    soon(lambda: gathered() and peers._connections.by_pid["g1"].version == 3)
    tell(1, epoch=2)
    clock.now += PULL_EVERY_S
    assert request() == WeightsRequest(pid="g1", newer_than=-1), "another worker may count anew"
    peers.close()


BAD_WEIGHTS: dict[str, Callable[[dict[str, NDArray[Any]]], dict[str, NDArray[Any]]]] = {
    "none": lambda good: {},
    "one missing": lambda good: {name: array for name, array in good.items() if name != "actor.0.weight"},
    "not finite": lambda good: good | {"actor.0.bias": np.full_like(good["actor.0.bias"], np.nan)},
    "of another shape": lambda good: good | {"targets.head.bias": np.zeros((2, 1, 2), np.float32)},
}


@pytest.mark.parametrize("bad", BAD_WEIGHTS.values(), ids=BAD_WEIGHTS.keys())
def test_weights_that_do_not_fit_count_as_none(
    context: Context, bad: Callable[[dict[str, NDArray[Any]]], dict[str, NDArray[Any]]]
) -> None:
    learner, clock = small_sac("g1"), Clock()
    router = bind(context, zmq.ROUTER, "tcp://127.0.0.1:*")
    peers = ReplicaPeers(context, "asker", learner.replica, clock=clock)
    peers.set_peers({"g1": at(bound_endpoint(router))})
    stand(peers)
    peers.ask(0, questions([0], "g1", seen(learner, 1)))
    assert router.poll(int(WAIT_S * 1000))
    received = receive_from(router)
    assert received is not None
    good, _ = learner.published.weights()
    arrays = {f"weights.{name}": array for name, array in bad(good).items()}
    send(router, Envelope(WeightsReply(version=2), arrays), peer=received[0])
    socket = peers._connections.by_pid["g1"].socket
    assert socket.poll(int(WAIT_S * 1000))
    assert len(peers.gather(0).rows) == 0
    assert not socket.poll(0), "it was taken"
    assert (peers.counts.own_used, peers.counts.late) == (1, 1)
    peers.close()


# The service


def answers_to(socket: Socket, messages: list[tuple[Message, dict[str, NDArray[Any]]]]) -> dict[int, Envelope]:
    """Send all, then hear all answers, by number."""
    for number, (message, arrays) in enumerate(messages):
        assert send(socket, Envelope(message, arrays, id=number))
    found = [receive(socket, WAIT_S) for _ in messages]
    return {envelope.id: envelope for envelope in found if envelope is not None}


def test_many_requests_are_answered_as_if_each_were_alone(context: Context, service: CriticService) -> None:
    learners = {pid: small_learner(pid) for pid in ("g", "p1")}
    for pid, learner in learners.items():
        service.serve(pid, learner.published)
    socket = connect(context, service.endpoint)
    assert socket.poll(int(WAIT_S * 1000), zmq.POLLOUT)
    messages: list[tuple[Message, dict[str, NDArray[Any]]]] = []
    for number in range(40):
        rows = seen(learners["g"], 1 + number % 5)
        q = np.full(len(rows), 6 if number % 10 == 3 else 0, np.int32)  # some name a state that does not exist
        wrong = {"q": q} if number % 10 == 7 else {"observation": rows, "q": q}
        messages.append((ValueRequest(pid=("g", "p1", "nobody")[number % 3]), wrong))
    found: list[Envelope] = []
    for first in range(0, len(messages), 10):  # a service queues 20 answers for a connection
        answers = answers_to(socket, messages[first : first + 10])
        found += [answers[number] for number in range(10)]
    for number, (message, arrays) in enumerate(messages):
        assert isinstance(message, ValueRequest)
        reply = found[number]
        if message.pid == "nobody" or number % 10 in (3, 7):
            assert isinstance(reply.message, Failure)
        else:
            expected = learners[message.pid].critic_values(arrays["observation"], arrays["q"])
            assert reply.arrays["value"] == pytest.approx(expected, abs=1e-6)
    socket.close(0)


def test_weights_are_given_if_newer_and_to_each_only_so_often(context: Context, service: CriticService) -> None:
    learner = small_sac("g1")
    for _ in range(4):
        learner.iterate(NoPeers())
    service.serve("g1", learner.published)
    first, second = connect(context, service.endpoint), connect(context, service.endpoint)
    for socket in (first, second):
        assert socket.poll(int(WAIT_S * 1000), zmq.POLLOUT)
    began = time.monotonic()
    asked: list[tuple[Message, dict[str, NDArray[Any]]]] = [
        (WeightsRequest(pid="g1", newer_than=4), {}),
        (WeightsRequest(pid="g1", newer_than=3), {}),
        (WeightsRequest(pid="g1", newer_than=-1), {}),
        (WeightsRequest(pid="g2", newer_than=0), {}),
    ]
    found = answers_to(first, asked)
    assert (found[0].message, found[0].arrays) == (WeightsReply(version=4), {})
    assert found[1].message == WeightsReply(version=4)
    assert {name.split(".")[1] for name in found[1].arrays} == {"actor", "targets"}
    if time.monotonic() - began < WEIGHTS_EVERY_S:
        assert isinstance(found[2].message, Failure)
    assert isinstance(found[3].message, Failure)
    assert answers_to(second, [asked[2]])[0].message == WeightsReply(version=4)
    first.close(0)
    second.close(0)


# Peers in the same process


def test_a_mixed_worker_asks_its_own_learners_and_other_processes(context: Context, service: CriticService) -> None:
    learners = {pid: small_sac(pid, seed=seed) for seed, pid in enumerate(PIDS)}
    here, there = {"g2": learners["g2"].critic_values}, ("g3", "g4")
    for pid in there:
        service.serve(pid, learners[pid].published)
    far = QueryPeers(context, "asker", value_shape=(2,))
    far.set_peers({pid: at(service.endpoint) for pid in there})
    stand(far)
    peers = MixedPeers(here, LocalPeers(here), far)
    observations, pids = seen(learners["g1"], 9), ("g2", "g3", "g4") * 3
    peers.ask(0, questions(list(range(9)), pids, observations, TO_G3))
    found = peers.gather(0, WAIT_S)
    assert sorted(found.rows.tolist()) == list(range(9))
    assert found.values.shape == (9, 2)
    assert (peers.near.counts.answered, far.counts.answered) == (3, 6)
    assert (peers.counts.asked, peers.counts.answered, peers.counts.own_used) == (9, 9, 0)
    here["g3"] = learners["g3"].critic_values  # a learner that moved into this worker
    peers.ask(1, questions([0], "g3", observations[:1], TO_G3))
    assert len(peers.gather(1).rows) == 1
    assert peers.near.counts.answered == 4
    far.close()
