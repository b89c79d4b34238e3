"""Shows a coordinator's published state on the terminal."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable

from rich.console import Console

from coordinator.error_boundary import ErrorBoundary
from coordinator.ui.dashboard import LiveDashboard
from t4nmtd_dist.core.errors import ProtocolError, RunError
from t4nmtd_dist.wire.auth.handshake import HandshakeMonitor, trouble
from t4nmtd_dist.wire.auth.keys import ClientKeys
from t4nmtd_dist.wire.messages import DashboardState
from t4nmtd_dist.wire.sockets import receive, subscribe
from t4nmtd_dist.wire.zmq_types import Context, Socket

POLL_S = 0.2
OVER = ("solved", "budget spent", "stopped")


def wants_plain(console: Console) -> bool:
    """Whether to print plain lines: no terminal, ``NO_COLOR``, or ``CI``."""
    return not console.is_terminal or bool(os.environ.get("NO_COLOR")) or bool(os.environ.get("CI"))


def watch(
    context: Context,
    endpoint: str,
    *,
    keep_going: Callable[[], bool],
    keys: ClientKeys | None = None,
    console: Console | None = None,
    silence_s: float | None = None,
) -> DashboardState | None:
    """Show the state published at ``endpoint`` until the run is over.

    Args:
        context: the process's ZeroMQ context.
        endpoint: the coordinator's state endpoint.
        keep_going: polled several times a second; False stops.
        keys: this client's, if the coordinator has keys.
        console: where to draw; by default the terminal.
        silence_s: stop after this many seconds without a state.

    Returns:
        The last state seen.

    Raises:
        RunError: if the coordinator refuses the keys, or requires some.
    """
    console = console or Console()
    socket = subscribe(context, endpoint, keys, monitored=True)
    handshakes = HandshakeMonitor(socket)
    errors = ErrorBoundary(lambda text: None)  # the traceback on stderr suffices
    last: DashboardState | None = None
    heard = time.monotonic()
    try:
        with LiveDashboard(console, plain=wants_plain(console)) as dashboard:
            visible = True
            while keep_going():
                state = _newest(socket)
                if state is None:
                    _check_refusal(handshakes, endpoint, keys)
                    if silence_s is not None and time.monotonic() - heard > silence_s:
                        break
                    continue
                last, heard = state, time.monotonic()
                with errors.guard("drawing the dashboard"):
                    visible = visible and dashboard.show(state)
                if state.phase in OVER:
                    break
    finally:
        handshakes.close()
        socket.close(0)
    return last


def _check_refusal(handshakes: HandshakeMonitor, endpoint: str, keys: ClientKeys | None) -> None:
    while (outcome := handshakes.next()) is not None:
        text = trouble(outcome, endpoint, keys)
        if text is not None and outcome != "broken":
            raise RunError(text)


def _newest(socket: Socket) -> DashboardState | None:
    """The newest waiting state; None after a short wait."""
    newest: DashboardState | None = None
    timeout = POLL_S
    while True:
        try:
            envelope = receive(socket, timeout)
        except ProtocolError:
            continue
        if envelope is None:
            return newest
        if isinstance(envelope.message, DashboardState):
            newest = envelope.message
        timeout = 0.0


class BackgroundViewer:
    """The dashboard in a thread, for the coordinator's own terminal.

    Args:
        endpoint: the coordinator's state endpoint.
        keys: this client's, if the coordinator has keys.
    """

    def __init__(self, context: Context, endpoint: str, keys: ClientKeys | None = None) -> None:
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(context, endpoint, keys), name="dashboard", daemon=True)
        self._thread.start()

    def _run(self, context: Context, endpoint: str, keys: ClientKeys | None) -> None:
        watch(context, endpoint, keep_going=lambda: not self._stop.is_set(), keys=keys)

    def close(self) -> None:
        """End the dashboard; returns within two seconds even if the terminal is stuck."""
        self._thread.join(timeout=1.0)
        self._stop.set()
        self._thread.join(timeout=1.0)
