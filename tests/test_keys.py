"""Key files, the list of clients, and who is let in where: files, and real sockets on loopback."""

from __future__ import annotations

import os
import stat
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st
from small_tasks import small_learner, small_task

from coordinator.endpoints import Access, BoundSockets
from coordinator.run_settings import RunSettings
from coordinator.service import CoordinatorService, RunStorage
from coordinator.state import CoordinatorState
from t4nmtd_dist.agents.common.peer_values import PeerValues, Questions
from t4nmtd_dist.core.errors import ConfigError, KeyFileError, RunError
from t4nmtd_dist.wire import limits
from t4nmtd_dist.wire.auth.allow_list import AllowedFolder
from t4nmtd_dist.wire.auth.handshake import HandshakeMonitor, Outcome
from t4nmtd_dist.wire.auth.key_folders import (
    add_client,
    allow,
    listed_clients,
    make_client_folder,
    make_coordinator_folder,
    revoke,
)
from t4nmtd_dist.wire.auth.keys import ClientKeys, load_client, load_coordinator, new_pair, read_secret, write_secret
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import Claim, Failure, Granted, LearnerStats, Message, Peer, Sync, SyncReply
from t4nmtd_dist.wire.peers.critic_client import QueryPeers
from t4nmtd_dist.wire.rate_limited_log import RateLimitedLog
from t4nmtd_dist.wire.secure_receiver import SecureReceiver
from t4nmtd_dist.wire.sockets import bind, bound_endpoint, connect, receive, send, subscribe
from t4nmtd_dist.wire.status_client import ask_status
from t4nmtd_dist.wire.zmq_types import Context, Socket, new_context
from workers.critic_service import CriticService

DEADLINE_S = 20.0
FREE_PORT = "tcp://127.0.0.1:*"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A coordinator's folder with one client in ``clients/client1``."""
    make_coordinator_folder(tmp_path / "keys", clients=1)
    return tmp_path / "keys"


def client_of(folder: Path, name: str = "client1") -> Path:
    return folder / "clients" / name


# Files


def test_secret_files_can_be_read_by_their_owner_only(folder: Path) -> None:
    modes = {path: stat.S_IMODE(path.stat().st_mode) for path in folder.rglob("*.secret")}
    assert len(modes) == 3
    assert set(modes.values()) == {0o600}
    assert stat.S_IMODE(folder.stat().st_mode) == stat.S_IMODE(client_of(folder).stat().st_mode) == 0o700


@pytest.mark.parametrize("umask", [0, 0o022, 0o077, 0o777])
def test_folders_and_files_of_keys_have_their_modes_whatever_the_umask(umask: int, tmp_path: Path) -> None:
    before = os.umask(umask)
    try:
        make_coordinator_folder(tmp_path / "keys", clients=1)
        add_client(tmp_path / "keys", "late")
        make_client_folder(tmp_path / "mine", "me", load_coordinator(tmp_path / "keys").public)
    finally:
        os.umask(before)
    made = [path for folder in ("keys", "mine") for path in ((tmp_path / folder), *(tmp_path / folder).rglob("*"))]
    wrong = {
        path.relative_to(tmp_path).as_posix(): oct(stat.S_IMODE(path.stat().st_mode))
        for path in made
        if stat.S_IMODE(path.stat().st_mode)
        != (0o700 if path.is_dir() else 0o600 if path.suffix == ".secret" else 0o644)
    }
    assert wrong == {}
    assert {"clients", "allowed"} <= {path.name for path in made}


def test_a_secret_file_that_others_can_read_is_not_used(folder: Path) -> None:
    (folder / "client.secret").chmod(0o640)
    with pytest.raises(KeyFileError, match="chmod 600"):
        load_client(folder)


def test_every_folder_serves_its_role(folder: Path) -> None:
    coordinator = load_coordinator(folder)
    assert load_client(folder).server == load_client(client_of(folder)).server == coordinator.public
    assert listed_clients(folder) == {
        "local": load_client(folder).own.public,
        "client1": load_client(client_of(folder)).own.public,
    }
    with pytest.raises(KeyFileError, match="not a client's"):
        load_coordinator(client_of(folder))


def test_a_secret_key_is_not_shown(folder: Path) -> None:
    keys = load_client(folder)
    assert keys.own.secret not in repr(keys)


def test_a_client_may_make_its_own_keys(folder: Path, tmp_path: Path) -> None:
    pair = make_client_folder(tmp_path / "mine", "ada", load_coordinator(folder).public)
    allow(folder, "ada", pair.public)
    assert load_client(tmp_path / "mine") == ClientKeys(pair, load_coordinator(folder).public)
    assert listed_clients(folder)["ada"] == pair.public
    assert pair.secret not in "".join(path.read_text() for path in folder.rglob("*") if path.is_file())


def refusals(folder: Path) -> dict[str, Callable[[], Any]]:
    return {
        "holds keys already": lambda: make_coordinator_folder(folder),
        "lists client1 already": lambda: add_client(folder, "client1"),
        "lists local already": lambda: allow(folder, "again", load_client(folder).own.public),
        "no client 'nobody'": lambda: revoke(folder, "nobody"),
        "cannot name a key": lambda: add_client(folder, "../escape"),
        "is no public key": lambda: allow(folder, "other", "short"),
        "is missing": lambda: load_client(folder / "elsewhere"),
    }


@pytest.mark.parametrize("text", refusals(Path()))
def test_what_cannot_be_done_is_refused_and_changes_nothing(folder: Path, text: str) -> None:
    before = {path: path.read_text() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(KeyFileError, match=text):
        refusals(folder)[text]()
    assert {path: path.read_text() for path in folder.rglob("*") if path.is_file()} == before


DAMAGE = [("t4nmtd key 1", "t4nmtd key 9"), ("name", "nom"), ('secret = "', 'secret = "x')]


@pytest.mark.parametrize(("old", "new"), DAMAGE)
def test_a_damaged_file_is_refused(folder: Path, old: str, new: str) -> None:
    path = folder / "client.secret"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(KeyFileError, match=r"client\.secret"):
        load_client(folder)


@given(content=st.binary(max_size=200))
def test_any_bytes_are_a_key_file_or_a_clear_refusal(content: bytes, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("any") / "any.secret"
    path.write_bytes(content)
    path.chmod(0o600)
    with pytest.raises(KeyFileError, match=r"any\.secret"):
        read_secret(path)


def test_a_file_is_never_overwritten(tmp_path: Path) -> None:
    path, first = tmp_path / "a.secret", new_pair("a")
    write_secret(path, first)
    with pytest.raises(KeyFileError, match="exists already"):
        write_secret(path, new_pair("a"))
    assert read_secret(path) == first


def test_a_running_program_sees_the_list_change(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("t4nmtd_dist.wire.auth.allow_list.REREAD_S", 0.0)
    told: list[str] = []
    allowed = AllowedFolder(folder, "always", told.append)
    key = load_client(client_of(folder)).own.public
    assert key in allowed
    assert allowed.name(key) == "client1"
    revoke(folder, "client1")
    assert allowed.refresh()
    assert key not in allowed
    assert not allowed.refresh()
    (folder / "allowed" / "client1.public").write_text("nonsense")
    assert allowed.refresh()
    assert "client1.public" in told[0]
    assert allowed.all() == {"always", load_client(folder).own.public}


def test_a_revocation_that_another_thread_saw_first_is_acted_upon(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("t4nmtd_dist.wire.auth.allow_list.REREAD_S", 0.0)
    key = load_client(client_of(folder)).own.public
    sockets = BoundSockets(Access("tcp://127.0.0.1:*", "tcp://127.0.0.1:*", folder))
    try:
        assert sockets.changed_keys() is None
        revoke(folder, "client1")
        assert sockets._allowed is not None
        assert sockets._allowed.refresh(), "the authenticator does this at every handshake"
        changed = sockets.changed_keys()
        assert changed is not None
        assert key not in changed
        assert sockets.changed_keys() is None
    finally:
        sockets.close()


# Limits


@given(pauses=st.lists(st.floats(0, 0.1), min_size=80, max_size=120))
def test_a_connection_gets_its_rate_and_no_more(pauses: list[float]) -> None:
    limiter = limits.RateLimiter(limits.Limits(100, messages_per_s=10, bytes_per_s=1e9))
    now, passed = 0.0, 0
    for pause in pauses:
        now += pause
        passed += limiter.allows(b"eager", 1, now)
    assert limiter.allows(b"other", 1, now)
    burst = 10 * limits.BURST_S
    assert burst - 1 <= passed <= burst + 10 * now + 1


def test_volume_is_limited_too() -> None:
    limiter = limits.RateLimiter(limits.Limits(10**6, messages_per_s=1000, bytes_per_s=1000))
    passed = [limiter.allows(b"eager", 1000, 0.0) for _ in range(10)]
    assert passed == [True] * 5 + [False] * 5
    assert limiter.allows(b"eager", 1, 2.0)


def test_who_sends_too_much_is_dropped_and_named_once(context: Context) -> None:
    told: list[str] = []
    router = bind(context, zmq.ROUTER, FREE_PORT)
    gate = SecureReceiver(router, limits.Limits(100, messages_per_s=1, bytes_per_s=1e6), None, told.append)
    dealer = connect(context, bound_endpoint(router))
    assert dealer.poll(int(DEADLINE_S * 1000), zmq.POLLOUT)
    for _ in range(20):
        assert send(dealer, Envelope(Failure(text="x")))
    taken, waiting = 0, 20
    while waiting and router.poll(int(DEADLINE_S * 1000)):
        before = taken
        taken += len(list(gate.arrivals(1)))
        waiting -= 1
        assert taken - before in (0, 1)
    assert taken == limits.BURST_S
    assert len(told) == 1
    assert "1 messages" in told[0]


def test_a_line_is_told_once_and_invented_ones_do_not_fill_the_log() -> None:
    told: list[str] = []
    notices = RateLimitedLog(told.append)
    for number in range(1000):
        notices.log("the same")
        notices.log(f"another {number}")
    assert told.count("the same") == 1
    assert len(told) == 100


@pytest.mark.parametrize("endpoint", ["tcp://0.0.0.0:*", "tcp://*:*"])
def test_keys_open_any_address(context: Context, endpoint: str) -> None:
    with pytest.raises(ConfigError, match="--keys"):
        bind(context, zmq.ROUTER, endpoint)
    assert bind(context, zmq.ROUTER, endpoint, own=new_pair("own"))


def test_without_an_authenticator_nobody_is_let_in(context: Context) -> None:
    server, client = new_pair("server"), new_pair("client")
    router = bind(context, zmq.ROUTER, FREE_PORT, own=server)
    dealer = connect(context, bound_endpoint(router), ClientKeys(client, server.public))
    assert not dealer.poll(500, zmq.POLLOUT)


# A running coordinator with keys


@dataclass
class Running:
    """A coordinator service with keys in a thread, and sockets to it from a process's own context."""

    service: CoordinatorService
    folder: Path
    context: Context

    def dealer(self, keys: ClientKeys | None) -> tuple[Socket, HandshakeMonitor]:
        socket = connect(self.context, self.service.control, keys, monitored=True)
        return socket, HandshakeMonitor(socket)

    def claim(self, pid: str, keys: ClientKeys, instance: str = "test") -> tuple[Socket, Message]:
        socket, _ = self.dealer(keys)
        return socket, asked(socket, Claim(role="learner", instance=instance, pid=pid))

    def events(self, text: str) -> list[str]:
        return [line.text for line in list(self.service.state.events) if text in line.text]


def asked(socket: Socket, message: Message) -> Message:
    """The answer to a message."""
    assert socket.poll(int(DEADLINE_S * 1000), zmq.POLLOUT)
    assert send(socket, Envelope(message, {}, "test"))
    envelope = receive(socket, DEADLINE_S)
    assert envelope is not None, "no answer within the deadline"
    return envelope.message


def sync(epoch: int = 1, pid: str = "p1") -> Sync:
    return Sync(pid=pid, epoch=epoch, sequence=0, version=0, start_cursor=0, stats=LearnerStats())


def until(monitor: HandshakeMonitor, *wanted: Outcome) -> Outcome:
    """The first of the wanted outcomes."""
    while (outcome := monitor.next(DEADLINE_S)) is not None:
        if outcome in wanted:
            return outcome
    raise AssertionError(f"none of {wanted} within the deadline")


def soon(holds: Callable[[], object]) -> None:
    """Wait until something holds."""
    pause, left = threading.Event(), DEADLINE_S
    while not holds():
        pause.wait(0.02)
        left -= 0.02
        assert left > 0, "not within the deadline"


@pytest.fixture
def running(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Running]:
    monkeypatch.setattr("coordinator.service.FAREWELL_S", 0.0)
    monkeypatch.setattr("coordinator.service.LONGEST_FAREWELL_S", 0.3)  # nobody here says a last word
    monkeypatch.setattr("t4nmtd_dist.wire.auth.allow_list.REREAD_S", 0.05)
    state = CoordinatorState(small_task(), RunSettings(seed=0, max_interactions=1000))
    service = CoordinatorService(state, RunStorage(tmp_path / "run"), Access(FREE_PORT, FREE_PORT, folder))
    thread = threading.Thread(target=service.serve, daemon=True)
    thread.start()
    context = new_context()
    yield Running(service, folder, context)
    context.destroy(linger=0)
    service.interrupt("the test is over")
    thread.join(DEADLINE_S)
    assert not thread.is_alive(), "the coordinator did not end within the deadline"


def strangers(folder: Path) -> dict[str, tuple[ClientKeys | None, set[Outcome], str]]:
    """Keys that must not get in, how that shows, and what the coordinator says of it."""
    good = load_client(client_of(folder))
    return {
        "no key": (None, {"mechanism", "broken"}, "no key"),
        "a key that is not on the list": (ClientKeys(new_pair("x"), good.server), {"refused"}, "not on the list"),
        "another coordinator's key": (good.to(new_pair("x").public), {"broken"}, "not this coordinator's"),
    }


@pytest.mark.slow
@pytest.mark.parametrize("who", ["no key", "a key that is not on the list", "another coordinator's key"])
def test_strangers_are_refused_told_of_once_and_disturb_nobody(running: Running, who: str) -> None:
    keys, outcomes, text = strangers(running.folder)[who]
    worker, granted = running.claim("p1", load_client(client_of(running.folder)))
    assert isinstance(granted, Granted)
    for _ in range(3):
        stranger, monitor = running.dealer(keys)
        assert until(monitor, "agreed", "refused", "mechanism", "broken") in outcomes
        assert not stranger.poll(50, zmq.POLLOUT)
    soon(lambda: running.events(text))
    assert isinstance(asked(worker, sync()), SyncReply)
    assert len(running.events("refused a client")) == 1


def test_a_key_that_is_added_gets_in_at_once(running: Running) -> None:
    keys = load_client(add_client(running.folder, "late"))
    soon(lambda: keys.own.public in running.service._sockets._allowed.all())  # type: ignore[union-attr]
    assert isinstance(running.claim("g", keys)[1], Granted)


def test_a_revoked_key_loses_its_connection_and_its_lease(running: Running) -> None:
    kept, _ = running.claim("p2", load_client(running.folder), "kept")
    socket, monitor = running.dealer(load_client(client_of(running.folder)))
    assert isinstance(asked(socket, Claim(role="learner", instance="gone", pid="p1")), Granted)
    until(monitor, "agreed")
    revoke(running.folder, "client1")
    assert until(monitor, "ended") == "ended"
    assert until(monitor, "agreed", "refused") == "refused"
    soon(lambda: running.events("p1 taken from gone: its key was revoked"))
    other, granted = running.claim("p1", load_client(running.folder), "heir")
    assert isinstance(granted, Granted)
    assert granted.epoch == 2
    reply = asked(kept, sync(pid="p2"))
    assert isinstance(reply, SyncReply)
    assert {pid: peer.key for pid, peer in reply.peers.items()} == {}  # the successor has given no endpoint
    assert isinstance(asked(other, sync(epoch=2)), SyncReply)


def test_a_revoked_key_gets_no_more_states(running: Running) -> None:
    socket = subscribe(running.context, running.service.publish, load_client(client_of(running.folder)), monitored=True)
    monitor = HandshakeMonitor(socket)
    assert receive(socket, DEADLINE_S) is not None
    revoke(running.folder, "client1")
    until(monitor, "ended")
    assert until(monitor, "agreed", "refused") == "refused"


def test_peers_are_told_each_others_keys(running: Running) -> None:
    keys = load_client(client_of(running.folder))
    asker, _ = running.claim("p1", load_client(running.folder))
    other, _ = running.dealer(keys)
    claim = Claim(role="learner", instance="other", pid="g", critic_endpoint="tcp://127.0.0.1:1")
    assert isinstance(asked(other, claim), Granted)
    reply = asked(asker, sync())
    assert isinstance(reply, SyncReply)
    assert reply.peers == {"g": Peer(endpoint="tcp://127.0.0.1:1", version=0, epoch=1, key=keys.own.public)}


def test_another_key_cannot_take_a_place_over_by_its_instance_name(running: Running) -> None:
    _, granted = running.claim("p1", load_client(running.folder), "same")
    assert isinstance(granted, Granted)
    assert not isinstance(running.claim("p1", load_client(client_of(running.folder)), "same")[1], Granted)


def test_status_needs_a_key_like_everything_else(running: Running) -> None:
    endpoint = running.service.control
    assert ask_status(running.context, endpoint, load_client(running.folder), DEADLINE_S).task == "task7"
    with pytest.raises(RunError, match="--keys"):
        ask_status(running.context, endpoint, None, DEADLINE_S)


# Critic sockets


def values(peers: QueryPeers, size: int) -> PeerValues:
    one = np.zeros(1, np.int32)
    peers.ask(0, Questions(one.astype(np.int64), ("g",), np.zeros((1, size), np.float32), one))
    return peers.gather(0, patience_s=0.2)


def test_critics_answer_those_whom_the_coordinator_named_and_only_as_long(context: Context) -> None:
    server, asker, told = new_pair("server"), new_pair("asker"), list[str]()
    service = CriticService(context, own=server, tell=told.append)
    learner = small_learner("g")
    service.serve("g", learner.published)
    size = learner.rollout.observations.shape[1]
    client = new_context()
    peers = QueryPeers(client, "asker", ClientKeys(asker, "unused"))
    try:
        service.allow([asker.public])
        peers.set_peers({"g": Peer(endpoint=service.endpoint, version=0, epoch=1, key=server.public)})
        soon(lambda: len(values(peers, size).rows) == 1)
        service.allow([])
        soon(lambda: told)
        assert f"ended the connection of key {asker.public}" in told[0]
        assert len(values(peers, size).rows) == 0
        service.allow([asker.public])
        soon(lambda: len(values(peers, size).rows) == 1)  # it tries again by itself
    finally:
        peers.close()
        client.destroy(linger=0)
        service.close()


@pytest.mark.parametrize("key", ["", "another"])
def test_a_peer_with_no_key_or_another_is_not_asked(context: Context, key: str) -> None:
    server, asker = new_pair("server"), new_pair("asker")
    service = CriticService(context, own=server)
    service.allow([asker.public])
    learner = small_learner("g")
    service.serve("g", learner.published)
    client = new_context()
    peers = QueryPeers(client, "asker", ClientKeys(asker, "unused"))
    claimed = new_pair("x").public if key else ""
    peers.set_peers({"g": Peer(endpoint=service.endpoint, version=0, epoch=1, key=claimed)})
    for _ in range(3):
        assert len(values(peers, learner.rollout.observations.shape[1]).rows) == 0
    peers.close()
    client.destroy(linger=0)
    service.close()
