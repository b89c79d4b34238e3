"""Fixtures of several test files."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from t4nmtd_dist.wire.zmq_types import Context, new_context
from workers.critic_service import CriticService


def pytest_configure() -> None:
    """Let what the tests start hear Ctrl-C and hang-ups, which children of background jobs and of nohup ignore."""
    for number, default in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, default)


@pytest.fixture(autouse=True, scope="session")
def _state_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What the tests make this user trust is forgotten with them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
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
