"""Keys as a user meets them: real processes on loopback, strangers, a revoked key, and an eavesdropper."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from packet_capture import Capture
from processes import Processes, Started, endpoints, events
from safetensors.numpy import load_file

from t4nmtd_dist.tasks import load_task
from t4nmtd_dist.wire.auth.key_folders import add_client, make_coordinator_folder, revoke
from t4nmtd_dist.wire.auth.keys import load_client, load_coordinator, new_pair, write_public, write_secret
from t4nmtd_dist.wire.messages import Status
from t4nmtd_dist.wire.status_client import ask_status
from t4nmtd_dist.wire.zmq_types import new_context

END_S = 10.0
REFUSED_S = 30.0
QUICK = ("--set", "ppo.rollout=32", "--set", "learner.hidden=[16]", "--set", "evaluation.every=200")
SUBTASKS = ("p1", "p2", "p3", "g")


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    folder = tmp_path / "keys"
    make_coordinator_folder(folder, clients=2)
    return folder


def client(keys: Path, name: str) -> Path:
    return keys / "clients" / name


def status(run: Path, keys: Path | None) -> Status:
    context = new_context()
    try:
        return ask_status(context, endpoints(run)[0], None if keys is None else load_client(keys), END_S)
    finally:
        context.term()


def stranger_with_other_keys(folder: Path, coordinator: Path) -> Path:
    """A folder with keys that are not on the coordinator's list."""
    write_secret(folder / "client.secret", new_pair("stranger"))
    write_public(folder / "coordinator.public", "coordinator", load_coordinator(coordinator).public)
    return folder


def ended_with(worker: Started, *texts: str) -> None:
    assert worker.wait(REFUSED_S) == 2, worker.story()
    assert "Traceback" not in worker.err
    for text in texts:
        assert text in worker.err, worker.story()


def test_strangers_are_refused_and_a_revoked_worker_is_thrown_out(processes: Processes, keys: Path) -> None:
    run = processes.folder / "run"
    coordinator = processes.coordinator(run, *QUICK, "--keys", str(keys))
    kept = processes.worker(run, "--pid", "p1", "--instance", "kept", "--keys", str(keys))
    revoked = processes.worker(run, "--pid", "p2", "--instance", "revoked", "--keys", str(client(keys, "client1")))
    processes.until(lambda: "kept takes p1 (epoch 1)" in events(run), "p1 is held")
    processes.until(lambda: "revoked takes p2 (epoch 1)" in events(run), "p2 is held")

    stranger = stranger_with_other_keys(processes.folder / "stranger", keys)
    misled = add_client(keys, "misled")
    (misled / "coordinator.public").unlink()
    write_public(misled / "coordinator.public", "coordinator", new_pair("x").public)
    refused = [
        processes.worker(run, "--pid", "p3"),
        processes.worker(run, "--pid", "p3", "--keys", str(stranger)),
        processes.worker(run, "--pid", "p3", "--keys", str(misled), "--wait", "3"),
    ]
    ended_with(refused[0], "takes only clients with keys", "--keys")
    ended_with(refused[1], "refused the key of stranger")
    ended_with(refused[2], "coordinator.public", "no coordinator answered")

    revoke(keys, "client1")
    ended_with(revoked, "refused the key of client1")
    processes.until(lambda: "p2 taken from revoked: its key was revoked" in events(run), "the lease is over")
    successor = processes.worker(run, "--pid", "p2", "--instance", "heir", "--keys", str(client(keys, "client2")))
    processes.until(lambda: "heir takes p2 (epoch 2)" in events(run), "p2 is held again")

    rows = {row.pid: row for row in status(run, keys).learners}
    assert (rows["p1"].epoch, rows["p1"].worker) == (1, "kept")
    assert kept.process.poll() is None
    coordinator.send(signal.SIGINT)
    assert [coordinator.wait(END_S), kept.wait(END_S), successor.wait(END_S)] == [130, 0, 0]
    refusals = [text for text in events(run) if "refused" in text or "ended the connection" in text]
    assert len(refusals) == len(set(refusals))
    assert len([text for text in refusals if "is not on the list" in text]) == 2  # the stranger's key, client1's
    assert len([text for text in refusals if "has no key" in text]) == 1


@pytest.fixture
def capture() -> Iterator[Capture]:
    try:
        listening = Capture()
    except PermissionError:
        pytest.skip("this process may not capture packets (root may)")
    yield listening
    listening.close()


def ports(run: Path, critics: Status) -> set[int]:
    found = [*endpoints(run), *critics.critics.values()]
    return {int(endpoint.rpartition(":")[2]) for endpoint in found}


def secrets(run: Path) -> dict[str, bytes]:
    """Pieces that every training sends: names of fields, labels and sub-tasks, and weights as they are in memory."""
    actors = load_file(run / "policy" / "actors.safetensors")
    weights = max(actors.values(), key=lambda array: array.size).tobytes()
    middle = len(weights) // 2
    return {
        "field": b"progress.reward",
        "pid": b"\xa3pid\xa2p1",
        "labels": load_task("task7").formula[:40].encode(),
        "weight names": b"weights.actor",
        "weights": weights[middle : middle + 64],
    }


@pytest.mark.parametrize("secured", [True, False], ids=["with keys", "without keys"])
def test_an_eavesdropper_reads_all_without_keys_and_nothing_with_them(
    secured: bool, processes: Processes, keys: Path, capture: Capture
) -> None:
    run = processes.folder / "run"
    own = ("--keys", str(keys)) if secured else ()
    coordinator = processes.coordinator(run, *QUICK, *own)
    worker = processes.worker(run, *(word for pid in SUBTASKS for word in ("--pid", pid)), *own)
    evaluator = processes.worker(run, "--evaluate", *own)
    processes.until(lambda: (run / "metrics" / "evaluations.csv").exists(), "an evaluation")
    used = ports(run, status(run, keys if secured else None))
    coordinator.send(signal.SIGINT)
    assert [coordinator.wait(END_S), worker.wait(END_S), evaluator.wait(END_S)] == [130, 0, 0]
    heard = capture.bytes_of(used)
    assert len(heard) > 10_000
    found = {name for name, piece in secrets(run).items() if piece in heard}
    assert found == (set() if secured else set(secrets(run)))
