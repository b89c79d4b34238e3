"""Fixtures of several test files, and which tests start processes."""

from __future__ import annotations

import re
import signal
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import hypothesis
import pytest
import torch
from processes import Processes
from validation import validate_after_every_event

from t4nmtd_dist.wire.zmq_types import Context, new_context
from workers.critic_service import CriticService

FIXTURES = {"commands": "command", "processes": "process", "attacked": "process", "held": "process"}
MARKERS = ("command", "process")
OUR_CODE = re.compile(r"(?:^|import |from )(?:t4nmtd_dist|coordinator|workers|envs)\b")
_running: list[pytest.Item] = []


def pytest_configure(config: pytest.Config) -> None:
    """Let what the tests start hear Ctrl-C and hang-ups, which children of background jobs and of nohup ignore."""
    for number, default in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, default)
    torch.set_num_threads(1)  # as in every process of a run; two test processes would compete for the cores
    sys.addaudithook(_check_marked)
    # Examples have no deadline of their own, since tests share the cores: the timeout is that of the whole test.
    hypothesis.settings.register_profile("project", deadline=None)
    hypothesis.settings.register_profile("fast", deadline=None, max_examples=20)
    hypothesis.settings.load_profile(config.getoption("--hypothesis-profile", None) or "project")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that take a fixture that starts processes."""
    for item in items:
        for marker in {FIXTURES[name] for name in getattr(item, "fixturenames", ()) if name in FIXTURES}:
            item.add_marker(marker)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, Any, Any]:
    """Remember which test runs, its fixtures included."""
    _running[:] = [item]
    try:
        return (yield)
    finally:
        _running.clear()


def _check_marked(event: str, arguments: tuple[Any, ...]) -> None:
    """Refuse to start a program of ours in a test that is marked with neither ``command`` nor ``process``."""
    if event == "subprocess.Popen" and _running and not any(map(_running[0].get_closest_marker, MARKERS)):
        program, *rest = map(str, arguments[1])
        if Path(program).name.startswith("t4nmtd") or any(OUR_CODE.search(argument) for argument in rest):
            raise RuntimeError(f"this test starts {program}: mark it with pytest.mark.command or process")


@pytest.fixture(autouse=True, scope="session")
def _state_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What the tests make this user trust is forgotten with them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture
def commands(tmp_path: Path) -> Iterator[Processes]:
    """Starts commands in a folder of the test and ends them with it; the test leaves time for other tests beside it."""
    started = Processes(tmp_path)
    yield started
    started.end()


@pytest.fixture
def processes(commands: Processes) -> Processes:
    """The same for a test that has deadlines, or says how long something takes: it runs alone."""
    return commands


@pytest.fixture(autouse=True, scope="session")
def _validated_state_machines() -> Iterator[None]:
    """A state machine that comes into a state that must not be fails the test that brings it there."""
    with pytest.MonkeyPatch.context() as patch:
        validate_after_every_event(patch)
        yield


@pytest.fixture
def context() -> Iterator[Context]:
    """A ZeroMQ context that ends without waiting for anything."""
    made = new_context()
    yield made
    made.destroy(linger=0)


@pytest.fixture
def service(context: Context) -> Iterator[CriticService]:
    """Answers peers, on loopback and without keys."""
    made = CriticService(context)
    yield made
    made.close()
