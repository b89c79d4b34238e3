"""``t4nmtd doctor``: the right diagnosis for each way in which a coordinator cannot be reached."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import msgpack
import pytest
import zmq
from small_tasks import small_task

from coordinator.endpoints import Access
from coordinator.run_settings import RunSettings
from coordinator.service import CoordinatorService, RunStorage
from coordinator.state import CoordinatorState
from t4nmtd_dist.cli import doctor
from t4nmtd_dist.cli.doctor import Finding, examine, findings
from t4nmtd_dist.wire.auth.key_folders import add_client, make_coordinator_folder, revoke
from t4nmtd_dist.wire.auth.keys import new_pair, write_public
from t4nmtd_dist.wire.messages import PROTOCOL_VERSION
from t4nmtd_dist.wire.sockets import bind, bound_endpoint
from t4nmtd_dist.wire.zmq_types import Context

WAIT_S = 2.0
DEADLINE_S = 20.0
FREE_PORT = "tcp://127.0.0.1:*"


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("doctor") / "keys"
    make_coordinator_folder(folder)
    return folder


def serve(folder: Path, keys: Path | None) -> Iterator[CoordinatorService]:
    state = CoordinatorState(small_task(), RunSettings(seed=0, max_interactions=1000))
    service = CoordinatorService(state, RunStorage(folder), Access(FREE_PORT, FREE_PORT, keys))
    thread = threading.Thread(target=service.serve, daemon=True)
    thread.start()
    yield service
    service.interrupt("the test is over")
    thread.join(DEADLINE_S)
    assert not thread.is_alive()


@pytest.fixture(scope="module")
def secured(tmp_path_factory: pytest.TempPathFactory, keys: Path) -> Iterator[CoordinatorService]:
    yield from serve(tmp_path_factory.mktemp("secured") / "run", keys)


@pytest.fixture(scope="module")
def open_to_all(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CoordinatorService]:
    yield from serve(tmp_path_factory.mktemp("open") / "run", None)


def failure(endpoint: str, keys: Path | None = None) -> Finding:
    """The one step that fails, which is the last, and says what to do."""
    found = list(findings(endpoint, keys, WAIT_S))
    assert [step.verdict for step in found] == ["ok"] * (len(found) - 1) + ["FAILED"]
    assert found[-1].advice
    return found[-1]


def unused() -> int:
    with socket.create_server(("127.0.0.1", 0)) as nobody:
        return int(nobody.getsockname()[1])


def test_a_coordinator_that_answers_passes_all_steps(secured: CoordinatorService, keys: Path) -> None:
    found = list(findings(secured.control, keys, DEADLINE_S))
    assert [step.step for step in found] == ["name", "port", "key", "protocol", "clock", "latency", "run"]
    assert {step.verdict for step in found} == {"ok"}
    assert "with keys" in found[1].text
    assert "local" in found[2].text


def test_the_exit_code_is_the_diagnosis(open_to_all: CoordinatorService, capsys: pytest.CaptureFixture[str]) -> None:
    assert examine(open_to_all.control, None, DEADLINE_S) == 0
    assert examine(f"tcp://127.0.0.1:{unused()}", None, WAIT_S) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[-2].startswith("port:     FAILED   nothing listens")
    assert lines[-1].startswith("          -> ")


def test_an_unknown_name() -> None:
    found = failure("tcp://no-such-machine.invalid:5570")
    assert found.step == "name"
    assert "no-such-machine.invalid is not known" in found.text


def test_nothing_listening(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "CONTROL_PORT", unused())
    found = failure(f"tcp://127.0.0.1:{unused()}")
    assert found.step == "port"
    assert "nothing listens" in found.text
    assert "start the coordinator" in found.advice


def test_a_wrong_port_beside_the_usual_one(open_to_all: CoordinatorService, monkeypatch: pytest.MonkeyPatch) -> None:
    usual = int(open_to_all.control.rpartition(":")[2])
    monkeypatch.setattr(doctor, "CONTROL_PORT", usual)
    found = failure(f"tcp://127.0.0.1:{unused()}")
    assert "wrong port?" in found.advice
    assert str(usual) in found.advice


@pytest.mark.parametrize("greeting", [b"SSH-2.0-OpenSSH_9.2\r\n", b"HTTP/1.1 400 Bad Request\r\n\r\n", b""])
def test_a_wrong_port_where_another_program_listens(greeting: bytes) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:

        def answer() -> None:
            connection, _ = other.accept()
            with connection:
                connection.sendall(greeting)
                if greeting:
                    connection.recv(100)

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        found = failure(f"tcp://127.0.0.1:{other.getsockname()[1]}")
        thread.join(DEADLINE_S)
    assert (found.step, "is no coordinator" in found.text) == ("port", True)
    assert "wrong port?" in found.advice


@pytest.mark.slow
@pytest.mark.parametrize("with_keys", [True, False])
def test_the_dashboards_port(
    with_keys: bool, secured: CoordinatorService, open_to_all: CoordinatorService, keys: Path
) -> None:
    found = failure((secured if with_keys else open_to_all).publish, keys if with_keys else None)
    assert "state port" in found.text
    assert "wrong port" in found.advice


def test_no_key_where_one_is_needed(secured: CoordinatorService) -> None:
    found = failure(secured.control)
    assert found.step == "key"
    assert "only clients with keys" in found.text


def test_a_key_where_none_is_used(open_to_all: CoordinatorService, keys: Path) -> None:
    found = failure(open_to_all.control, keys)
    assert found.step == "key"
    assert "has none" in found.text


def test_a_key_that_was_revoked(secured: CoordinatorService, keys: Path) -> None:
    folder = add_client(keys, "gone")
    revoke(keys, "gone")
    found = failure(secured.control, folder)
    assert found.step == "key"
    assert "does not let in the key of gone" in found.text
    assert "keys add" in found.advice


@pytest.mark.slow
def test_the_key_of_another_coordinator(secured: CoordinatorService, keys: Path) -> None:
    folder = add_client(keys, "misled")
    (folder / "coordinator.public").unlink()
    write_public(folder / "coordinator.public", "coordinator", new_pair("x").public)
    found = failure(secured.control, folder)
    assert found.step == "key"
    assert "does not have the key" in found.text
    assert "another coordinator's" in found.advice


def test_key_files_that_are_missing(secured: CoordinatorService, tmp_path: Path) -> None:
    found = failure(secured.control, tmp_path)
    assert found.step == "key"
    assert "is missing" in found.text


def test_another_protocol_version(context: Context) -> None:
    router = bind(context, zmq.ROUTER, FREE_PORT)

    def answer() -> None:
        if router.poll(int(DEADLINE_S * 1000)):
            peer, *_ = router.recv_multipart()
            router.send_multipart([peer, msgpack.packb({"v": PROTOCOL_VERSION + 1, "kind": "hello"})])

    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    found = failure(bound_endpoint(router))
    thread.join(DEADLINE_S)
    assert found.step == "protocol"
    assert f"protocol version {PROTOCOL_VERSION + 1}" in found.text
    assert "same version" in found.advice


@pytest.mark.slow
def test_a_socket_that_says_nothing(context: Context) -> None:
    silent = bind(context, zmq.ROUTER, FREE_PORT)
    found = failure(bound_endpoint(silent))
    assert found.step == "protocol"
    assert "did not answer" in found.text


@pytest.mark.slow
def test_a_firewall_that_drops() -> None:
    """A listener whose queue is full drops what knocks, just as such a firewall does."""
    with ExitStack() as stack:
        listener = stack.enter_context(socket.socket())
        listener.bind(("127.0.0.1", 0))
        listener.listen(0)
        address = listener.getsockname()
        for _ in range(4):
            knocking = stack.enter_context(socket.socket())
            knocking.setblocking(False)
            knocking.connect_ex(address)
        found = failure(f"tcp://127.0.0.1:{address[1]}")
    assert found.step == "port"
    assert "no answer" in found.text
    assert "firewall" in found.advice


@pytest.mark.slow
@pytest.mark.parametrize(("ahead_s", "verdict"), [(0.5, "ok"), (-4.0, "ok"), (60.0, "warning"), (-60.0, "warning")])
def test_a_clock_that_differs(ahead_s: float, verdict: str) -> None:
    found = doctor._clock(ahead_s)
    assert found.verdict == verdict
    assert ("behind" in found.text) == (ahead_s < 0)


@pytest.mark.slow
def test_a_long_way() -> None:
    assert doctor._round_trip([0.001, 0.5, 0.002]).verdict == "ok"
    assert doctor._round_trip([0.3, 0.5, 0.2]).verdict == "warning"
