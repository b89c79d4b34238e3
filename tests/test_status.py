"""``t4nmtd status``: what it says, and its exit code, as health checks see it."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import Processes, endpoints, events

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.wire.endpoints import complete_endpoint


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Processes]:
    started = Processes(tmp_path_factory.mktemp("status"))
    yield started
    started.end()


@pytest.fixture(scope="module")
def run(processes: Processes) -> Path:
    """Run directory of a coordinator whose sub-task p1 is held by the worker ``first``."""
    folder = processes.folder / "run"
    processes.coordinator(folder)
    processes.worker(folder, "--pid", "p1", "--instance", "first")
    processes.until(lambda: "first takes p1 (epoch 1)" in events(folder), "p1 is held")
    return folder


def asked(processes: Processes, *arguments: str) -> tuple[int, str, str]:
    started = processes.start("t4nmtd", "status", *arguments)
    return started.wait(30), started.out, started.err


def test_a_person_reads_who_learns_what(processes: Processes, run: Path) -> None:
    code, out, err = asked(processes, "--connect", endpoints(run)[0])
    assert (code, err) == (0, "")
    assert "task7 seed 0" in out
    assert "first" in next(line for line in out.splitlines() if line.startswith("p1:"))
    assert "no worker" in next(line for line in out.splitlines() if line.startswith("g:"))


def test_a_program_reads_json(processes: Processes, run: Path) -> None:
    host, port = "127.0.0.1", endpoints(run)[0].rpartition(":")[2]
    code, out, _ = asked(processes, "--connect", f"{host}:{port}", "--json")
    assert code == 0
    status = json.loads(out)
    assert (status["task"], status["interactions"]) == ("task7", pytest.approx(status["interactions"]))
    assert {row["pid"]: row["worker"] for row in status["learners"]} == {"p1": "first", "p2": "", "p3": "", "g": ""}
    assert list(status["critics"]) == ["p1"]


def test_a_health_check_is_silent_when_all_is_well_and_fails_when_not(processes: Processes, run: Path) -> None:
    assert asked(processes, "--check", "--connect", endpoints(run)[0]) == (0, "", "")
    code, out, err = asked(processes, "--check", "--connect", "tcp://127.0.0.1:9", "--wait", "1")
    assert (code, out) == (1, "")
    assert "no coordinator answered at tcp://127.0.0.1:9" in err


def test_a_coordinator_that_hangs_is_not_healthy(processes: Processes) -> None:
    run = processes.folder / "hanging"
    coordinator = processes.coordinator(run)
    coordinator.send(signal.SIGSTOP)
    code, _, err = asked(processes, "--check", "--connect", endpoints(run)[0], "--wait", "1")
    coordinator.send(signal.SIGCONT)
    assert code == 1
    assert "no coordinator answered" in err or "did not answer" in err


@pytest.mark.parametrize(
    ("text", "endpoint"),
    [
        ("host", "tcp://host:5570"),
        ("host:1", "tcp://host:1"),
        ("tcp://host:1", "tcp://host:1"),
        ("tcp://host", "tcp://host:5570"),
    ],
)
def test_an_endpoint_may_be_given_in_part(text: str, endpoint: str) -> None:
    assert complete_endpoint(text, 5570) == endpoint


@pytest.mark.parametrize("text", ["", "http://host", "host:", "a b", "host:port"])
def test_what_is_no_endpoint_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="tcp://HOST:PORT"):
        complete_endpoint(text, 5570)
