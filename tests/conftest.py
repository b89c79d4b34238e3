"""Fixtures of several test files."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from t4nmtd_dist.wire.sockets import Context, new_context
from workers.critic_service import CriticService


def pytest_configure() -> None:
    """Let what the tests start hear Ctrl-C: a shell's background jobs ignore it, and so would all their children."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


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
