"""Real sockets on loopback: endpoints, bad bytes to a running coordinator, dashboards that attach late."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zmq
from hypothesis import example, given, settings
from hypothesis import strategies as st
from routers import receive_from
from small_tasks import small_task

from coordinator.endpoints import Access
from coordinator.run_settings import RunSettings
from coordinator.service import CoordinatorService, RunStorage
from coordinator.state import CoordinatorState
from t4nmtd_dist.core.errors import ConfigError, ProtocolError, RunError
from t4nmtd_dist.wire.codec import Envelope, decode
from t4nmtd_dist.wire.endpoints import check_endpoint
from t4nmtd_dist.wire.messages import (
    Claim,
    DashboardState,
    Failure,
    Goodbye,
    Granted,
    LearnerStats,
    Message,
    Refused,
    Release,
    Sync,
    SyncReply,
)
from t4nmtd_dist.wire.sockets import bind, bound_endpoint, connect, receive, send, subscribe
from t4nmtd_dist.wire.zmq_types import Context, Socket, new_context

DEADLINE_S = 10.0
FREE_PORT = "tcp://127.0.0.1:*"


def answer(of: Socket) -> Message:
    """The next message, within the deadline."""
    envelope = receive(of, DEADLINE_S)
    assert envelope is not None, "no answer within the deadline"
    return envelope.message


def tell(socket: Socket, message: Message, arrays: dict[str, np.ndarray] | None = None) -> None:
    """Send once the connection stands."""
    assert socket.poll(int(DEADLINE_S * 1000), zmq.POLLOUT), "no connection within the deadline"
    assert send(socket, Envelope(message, arrays or {}, "test"))


# Endpoints


def test_a_port_in_use_is_refused_by_name(context: Context) -> None:
    listening = bind(context, zmq.ROUTER, FREE_PORT)
    endpoint = bound_endpoint(listening)
    with pytest.raises(ConfigError, match=f"{endpoint} is in use"):
        bind(context, zmq.XPUB, endpoint)


@pytest.mark.parametrize("endpoint", ["tcp://0.0.0.0:*", "tcp://*:*", "tcp://[::]:*", "tcp://192.0.2.1:5570"])
def test_addresses_that_others_can_reach_need_the_word(context: Context, endpoint: str) -> None:
    with pytest.raises(ConfigError, match="--insecure"):
        bind(context, zmq.ROUTER, endpoint)


def test_insecure_allows_any_address(context: Context) -> None:
    assert bound_endpoint(bind(context, zmq.ROUTER, "tcp://0.0.0.0:*", insecure=True)).startswith("tcp://0.0.0.0:")


MALFORMED = [
    "",
    "5570",
    "127.0.0.1:5570",
    "udp://127.0.0.1:1",
    "tcp://127.0.0.1",
    "tcp://:1",
    "tcp://h:65536",
    "tcp://h:²",
]


@pytest.mark.parametrize("endpoint", MALFORMED)
def test_malformed_endpoints_are_refused_with_the_form_expected(context: Context, endpoint: str) -> None:
    for use in (connect, subscribe, lambda c, e: bind(c, zmq.ROUTER, e)):
        with pytest.raises(ConfigError, match="tcp://HOST:PORT"):
            use(context, endpoint)


@pytest.mark.parametrize("endpoint", ["tcp://a b:1", "tcp://;:1", "tcp://*:1", "tcp://127.0.0.1:*", "tcp://[::1:80"])
def test_endpoints_that_cannot_be_connected_to_are_refused(context: Context, endpoint: str) -> None:
    for use in (connect, subscribe):
        with pytest.raises(ConfigError, match=r"endpoint|cannot connect"):
            use(context, endpoint)


@settings(max_examples=100)
@given(st.text(max_size=20) | st.text(max_size=20).map("tcp://".__add__) | st.text(max_size=4).map("tcp://h:".__add__))
@example("tcp://[::1:80")
def test_any_text_is_an_endpoint_or_a_clear_refusal(endpoint: str) -> None:
    context = new_context()
    try:
        check_endpoint(endpoint)
        bind(context, zmq.ROUTER, endpoint)
    except ConfigError:
        pass
    finally:
        context.destroy(linger=0)


def test_nothing_is_queued_for_a_peer_that_is_away(context: Context) -> None:
    with socket.create_server(("127.0.0.1", 0)) as nobody:
        endpoint = f"tcp://127.0.0.1:{nobody.getsockname()[1]}"
    assert not send(connect(context, endpoint), Envelope(Failure(text="hello")))


def test_an_answer_to_a_peer_that_has_gone_is_dropped(context: Context) -> None:
    router = bind(context, zmq.ROUTER, FREE_PORT)
    send(router, Envelope(Failure(text="hello")), peer=b"nobody")
    dealer = connect(context, bound_endpoint(router))
    tell(dealer, Failure(text="still there?"))
    assert isinstance(receive_from_soon(router), Envelope)


def test_a_router_tells_who_sent_what_and_survives_nonsense(context: Context) -> None:
    router = bind(context, zmq.ROUTER, FREE_PORT)
    dealer = connect(context, bound_endpoint(router))
    assert receive_from(router) is None
    assert dealer.poll(int(DEADLINE_S * 1000), zmq.POLLOUT)
    dealer.send_multipart([b"nonsense"])
    tell(dealer, Failure(text="hello"))
    assert router.poll(int(DEADLINE_S * 1000))
    first, second = receive_from_soon(router), receive_from_soon(router)
    assert "msgpack" in str(first)
    assert isinstance(second, Envelope)
    assert second.message == Failure(text="hello")


def receive_from_soon(router: Socket) -> Envelope | ProtocolError:
    """The next message at a ROUTER, within the deadline."""
    assert router.poll(int(DEADLINE_S * 1000))
    received = receive_from(router)
    assert received is not None
    return received[1]


# A running coordinator


@dataclass
class Running:
    """A coordinator service in a thread, and sockets to it."""

    service: CoordinatorService
    thread: threading.Thread
    context: Context

    def worker(self) -> Socket:
        return connect(self.context, self.service.control)

    def claim(self, pid: str = "p1") -> tuple[Socket, Granted]:
        socket = self.worker()
        tell(socket, Claim(role="learner", instance="test", pid=pid))
        granted = answer(socket)
        assert isinstance(granted, Granted)
        return socket, granted


def service_in(folder: Path, endpoints: tuple[str, str] = (FREE_PORT, FREE_PORT)) -> CoordinatorService:
    state = CoordinatorState(small_task(), RunSettings(seed=0, max_interactions=1000))
    return CoordinatorService(state, RunStorage(folder / "run"), Access(*endpoints))


@pytest.fixture
def running(tmp_path: Path, context: Context, monkeypatch: pytest.MonkeyPatch) -> Iterator[Running]:
    monkeypatch.setattr("coordinator.service.FAREWELL_S", 0.0)
    monkeypatch.setattr("coordinator.service.LONGEST_FAREWELL_S", 0.3)  # nobody here says a last word
    service = service_in(tmp_path)
    thread = threading.Thread(target=service.serve, daemon=True)
    thread.start()
    yield Running(service, thread, context)
    service.interrupt("the test is over")
    thread.join(DEADLINE_S)
    assert not thread.is_alive(), "the coordinator did not end within the deadline"


BAD_FRAMES = {
    "not msgpack": [b"\xc1"],
    "empty": [b""],
    "another version": [msgpack.packb({"v": 99})],
    "unknown kind": [
        msgpack.packb({"v": 1, "kind": "reboot", "sender": "", "id": 0, "body": {}, "arrays": []}),
    ],
    "array missing": [
        msgpack.packb(
            {
                "v": 1,
                "kind": "release",
                "sender": "",
                "id": 0,
                "body": {"pid": "p1", "epoch": 1},
                "arrays": [("a", "<f4", [1])],
            }
        ),
    ],
}


@pytest.mark.slow
@pytest.mark.parametrize("frames", BAD_FRAMES.values(), ids=BAD_FRAMES.keys())
def test_the_coordinator_answers_malformed_frames_and_goes_on(running: Running, frames: list[bytes]) -> None:
    socket = running.worker()
    assert socket.poll(int(DEADLINE_S * 1000), zmq.POLLOUT)
    socket.send_multipart(frames)
    assert isinstance(answer(socket), Failure)
    assert isinstance(running.claim()[1], Granted)


def test_the_coordinator_refuses_messages_that_are_not_for_it(running: Running) -> None:
    socket = running.worker()
    tell(socket, Goodbye(reason="x"))
    failure = answer(socket)
    assert isinstance(failure, Failure)
    assert "Goodbye" in failure.text


def test_wrong_arrays_in_a_sync_are_answered_and_the_lease_stays(running: Running) -> None:
    socket, granted = running.claim()
    sync = Sync(
        pid="p1", epoch=granted.epoch, sequence=1, version=0, start_cursor=0, stats=LearnerStats(phase="training")
    )
    tell(socket, sync, {"progress.q": np.full((1, 3), 99, np.int32), "progress.reward": np.zeros(1)})
    assert isinstance(answer(socket), Failure)
    tell(socket, sync)
    assert isinstance(answer(socket), SyncReply)


def test_messages_of_a_claim_come_back_whole(running: Running) -> None:
    granted = running.claim("g")[1]
    assert granted.pid == "g"
    assert granted.dfa == small_task().dfa.to_json()
    other = running.worker()
    tell(other, Claim(role="learner", instance="other", pid="g"))
    refused = answer(other)
    assert isinstance(refused, Refused)
    assert refused.final


def test_a_dashboard_gets_a_state_at_once(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    first = subscribe(running.context, running.service.publish)
    assert isinstance(answer(first), DashboardState)
    monkeypatch.setattr("coordinator.service.PUBLISH_S", 3600.0)
    while receive(first, 0.5) is not None:
        pass  # until the last publication under the old interval
    late = subscribe(running.context, running.service.publish)
    assert isinstance(answer(late), DashboardState)


def test_nonsense_from_a_dashboard_changes_nothing(running: Running) -> None:
    raw: Socket = running.context.socket(zmq.XSUB)
    raw.connect(running.service.publish)
    raw.send(b"\x01")
    assert raw.poll(int(DEADLINE_S * 1000))
    raw.send_multipart([b"nonsense", b""])
    assert isinstance(decode(raw.recv_multipart()).message, DashboardState)
    assert isinstance(running.claim()[1], Granted)


def test_an_interrupted_coordinator_says_goodbye_to_workers_and_ends(running: Running) -> None:
    worker, _ = running.claim()
    running.service.interrupt("asked")
    assert answer(worker) == Goodbye(reason="stopped")
    running.thread.join(DEADLINE_S)
    assert not running.thread.is_alive()


def test_a_learner_without_a_last_word_is_told_of(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coordinator.service.LONGEST_FAREWELL_S", 0.1)
    running.claim("p1")
    socket, granted = running.claim("g")
    tell(socket, Release(pid="g", epoch=granted.epoch))
    running.service.interrupt("asked")
    running.thread.join(DEADLINE_S)
    told = [line.text for line in running.service.state.events]
    assert any(text.startswith("no last word of p1: ") for text in told), told


def test_who_stops_a_coordinator_twice_waits_less_for_last_words(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coordinator.service.HURRIED_FAREWELL_S", 0.0)
    monkeypatch.setattr("coordinator.service.LONGEST_FAREWELL_S", 1e9)
    worker, _ = running.claim()
    running.service.interrupt("asked")
    assert answer(worker) == Goodbye(reason="stopped")
    assert running.thread.is_alive()
    running.service.interrupt("asked again")
    running.thread.join(5.0)
    assert not running.thread.is_alive()


def test_a_coordinator_without_its_port_leaves_no_run_behind(tmp_path: Path, context: Context) -> None:
    listening = bind(context, zmq.ROUTER, FREE_PORT)
    with pytest.raises(ConfigError, match="in use"):
        service_in(tmp_path, (FREE_PORT, bound_endpoint(listening)))
    assert not (tmp_path / "run").exists()


def test_a_second_run_in_one_folder_is_refused(running: Running, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="--restart"):
        service_in(tmp_path)
