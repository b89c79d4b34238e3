"""Floods of bytes against the real sockets of a coordinator: it answers afterwards, and its memory stays bounded."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import attacks
import numpy as np
import pytest
import zmq
from processes import Processes, endpoints, events

from t4nmtd_dist.wire.codec import MAX_MESSAGE_BYTES, Envelope
from t4nmtd_dist.wire.connection_guard import ConnectionGuard
from t4nmtd_dist.wire.limits import CONTROL_LIMITS, Limits
from t4nmtd_dist.wire.messages import DashboardState, Release
from t4nmtd_dist.wire.secure_receiver import SecureReceiver
from t4nmtd_dist.wire.sockets import bind, bound_endpoint, connect, receive, send, subscribe
from t4nmtd_dist.wire.status_client import ask_status
from t4nmtd_dist.wire.zmq_types import Context, new_context

MIB = 1 << 20
DEADLINE_S = 20.0
KEPT_S = 1.0


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Processes, Path]]:
    """A coordinator whose only visitors mean harm."""
    started = Processes(tmp_path_factory.mktemp("attacked"))
    run = started.folder / "run"
    try:
        started.coordinator(run, "--no-dashboard")
        yield started, run
    finally:
        started.end()


def growth(attacked: tuple[Processes, Path], attack: Callable[[], object]) -> tuple[int, int]:
    """By how many bytes the coordinator's memory grows at most during an attack, and by how many for good.

    Afterwards the coordinator must answer, and a new dashboard must get a state.
    """
    started, run = attacked
    number = started.started[0].process.pid
    watch = attacks.MemoryWatch([number])
    attack()
    context = new_context()
    assert ask_status(context, endpoints(run)[0], None, DEADLINE_S).task == "task7"
    dashboard = subscribe(context, endpoints(run)[1])
    envelope = receive(dashboard, DEADLINE_S)
    assert envelope is not None, started.started[0].story()
    assert isinstance(envelope.message, DashboardState)
    context.destroy(linger=0)
    watch.close()
    deadline, kept = time.monotonic() + KEPT_S, watch.now()[number]
    while time.monotonic() < deadline:  # libzmq frees what a connection left some moments after it
        kept = min(kept, watch.now()[number])
        time.sleep(0.1)
    return watch.peak[number] - watch.before[number], kept - watch.before[number]


def test_a_message_that_never_ends_is_cut_short(attacked: tuple[Processes, Path]) -> None:
    control = endpoints(attacked[1])[0]
    sent: list[int] = []
    peak, _ = growth(attacked, lambda: sent.append(attacks.endless_multipart(control)))
    assert sent[0] < 1 << 29, "the connection was not ended"
    assert peak < 6 * MAX_MESSAGE_BYTES
    assert any("sent more than can be taken in" in text for text in events(attacked[1]))


def test_empty_frames_do_not_fill_the_memory(attacked: tuple[Processes, Path]) -> None:
    control = endpoints(attacked[1])[0]
    sent: list[int] = []
    peak, _ = growth(attacked, lambda: sent.append(attacks.empty_frames(control)))
    assert sent[0] < 32 * MIB, "the connection was not ended"
    assert peak < 6 * MAX_MESSAGE_BYTES


def test_forty_thousand_subscriptions_are_not_kept(attacked: tuple[Processes, Path]) -> None:
    state = endpoints(attacked[1])[1]
    sent: list[int] = []
    peak, _ = growth(attacked, lambda: sent.append(attacks.subscriptions(state)))
    assert sent[0] < 40_000 * 500, "the connection was not ended"
    assert peak < 100 * MIB


def test_repeated_floods_leave_little_behind(attacked: tuple[Processes, Path]) -> None:
    control, state = endpoints(attacked[1])

    def floods() -> None:
        for _ in range(3):
            attacks.together(
                lambda: attacks.endless_multipart(control),
                lambda: attacks.empty_frames(control),
                lambda: attacks.subscriptions(state),
            )

    first, kept = growth(attacked, floods)
    again, kept_again = growth(attacked, floods)
    print(f"peaks {first / MIB:.0f} and {again / MIB:.0f} MiB, kept {kept / MIB:.0f} and {kept_again / MIB:.0f} MiB")
    assert kept_again < 40 * MIB, "every flood leaves something behind"


def test_answers_that_nobody_reads_are_dropped(attacked: tuple[Processes, Path]) -> None:
    control = endpoints(attacked[1])[0]
    peak, _ = growth(attacked, lambda: attacks.together(*[lambda: attacks.unread_answers(control)] * 4))
    assert peak < 40 * MIB


def test_connections_that_say_nothing_take_no_memory_and_no_places(attacked: tuple[Processes, Path]) -> None:
    control = endpoints(attacked[1])[0]
    peak, _ = growth(attacked, lambda: attacks.many_connections(control))
    assert peak < 40 * MIB


# The guard by itself


def test_a_large_message_of_an_honest_sender_arrives_whole_while_the_limit_is_near(context: Context) -> None:
    limits = Limits(frame_bytes=4 * MIB, messages_per_s=1e6, bytes_per_s=1e12, unread_bytes=5 * MIB)
    router, told = bind(context, zmq.ROUTER, "tcp://127.0.0.1:*"), list[str]()
    guard = ConnectionGuard(router, limits, told.append)
    gate = SecureReceiver(router, limits, None, told.append, guard)
    dealer = connect(context, bound_endpoint(router))
    try:
        assert dealer.poll(int(DEADLINE_S * 1000), zmq.POLLOUT)
        for number in range(20):
            assert send(dealer, Envelope(Release(pid="p", epoch=number), {"a": np.zeros(3 * MIB // 8)}))
            assert router.poll(int(DEADLINE_S * 1000))
            (arrival,) = gate.arrivals(10)
            assert isinstance(arrival.content, Envelope)
            assert arrival.content.message == Release(pid="p", epoch=number)
        assert told == []
    finally:
        guard.close()


def test_messages_that_nobody_takes_in_time_are_bounded_too(context: Context) -> None:
    limits = Limits(frame_bytes=4 * MIB, messages_per_s=1e6, bytes_per_s=1e12, unread_bytes=5 * MIB)
    router, told = bind(context, zmq.ROUTER, "tcp://127.0.0.1:*"), list[str]()
    ended = threading.Event()
    guard = ConnectionGuard(router, limits, lambda text: (told.append(text), ended.set()))
    dealer = connect(context, bound_endpoint(router))
    try:
        assert dealer.poll(int(DEADLINE_S * 1000), zmq.POLLOUT)
        for number in range(20):
            send(dealer, Envelope(Release(pid="p", epoch=number), {"a": np.zeros(MIB // 8)}))
        assert ended.wait(DEADLINE_S)
        assert "at most 5 MiB" in told[0]
    finally:
        guard.close()


def test_no_more_connections_than_allowed_are_kept(context: Context) -> None:
    limits = Limits(1000, 1e6, 1e12, connections=3)
    router, told = bind(context, zmq.ROUTER, "tcp://127.0.0.1:*"), list[str]()
    ended = threading.Event()
    guard = ConnectionGuard(router, limits, lambda text: (told.append(text), ended.set()))
    try:
        first = [connect(context, bound_endpoint(router)) for _ in range(3)]
        assert all(dealer.poll(int(DEADLINE_S * 1000), zmq.POLLOUT) for dealer in first)
        connections = [*first, connect(context, bound_endpoint(router))]
        assert len(connections) == 4
        assert ended.wait(DEADLINE_S)
        assert "more than 3" in told[0]
        for dealer in first:
            assert send(dealer, Envelope(Release(pid="p", epoch=1)))
            assert router.poll(int(DEADLINE_S * 1000))
            router.recv_multipart()
    finally:
        guard.close()


def test_learners_that_send_large_weights_at_the_same_time_are_not_ended(context: Context) -> None:
    router, told = bind(context, zmq.ROUTER, "tcp://127.0.0.1:*"), list[str]()
    guard = ConnectionGuard(router, CONTROL_LIMITS, told.append)
    gate = SecureReceiver(router, CONTROL_LIMITS, None, told.append, guard)
    dealers = [connect(context, bound_endpoint(router)) for _ in range(8)]
    kept: list[Envelope] = []
    try:
        for dealer in dealers:
            assert dealer.poll(int(DEADLINE_S * 1000), zmq.POLLOUT)
        for number, dealer in enumerate(dealers):
            assert send(dealer, Envelope(Release(pid="p", epoch=number), {"a": np.ones(6 * MIB // 8)}))
        time.sleep(0.3)  # all wait to be read
        deadline = time.monotonic() + DEADLINE_S
        while len(kept) < 8 and time.monotonic() < deadline and not told:
            for arrival in gate.arrivals(1):
                assert isinstance(arrival.content, Envelope)
                kept.append(arrival.content)
            time.sleep(0.02)  # the guard looks in between
        assert (told, len(kept)) == ([], 8)
    finally:
        guard.close()
