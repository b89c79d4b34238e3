"""``t4nmtd dashboard``: attaches to a running coordinator."""

from __future__ import annotations

from pathlib import Path

from coordinator.ui.dashboard import export_svg
from coordinator.ui.viewer import watch
from t4nmtd_dist.core.errors import RunError
from t4nmtd_dist.wire.auth.keys import load_client
from t4nmtd_dist.wire.messages import DashboardState
from t4nmtd_dist.wire.sockets import receive, subscribe
from t4nmtd_dist.wire.zmq_types import new_context


def follow(endpoint: str, wait_s: float, *, keys: Path | None = None) -> int:
    """Show the dashboard until the run is over.

    Raises:
        RunError: if no state arrives for ``wait_s`` seconds, or the coordinator refuses this client.
        KeyFileError: if the keys cannot be used.
    """
    context = new_context()
    try:
        own = None if keys is None else load_client(keys)
        last = watch(context, endpoint, keep_going=lambda: True, keys=own, silence_s=wait_s)
    finally:
        context.term()
    if last is None:
        raise RunError(_silence(endpoint, wait_s))
    return 0


def save_picture(endpoint: str, wait_s: float, path: Path, width: int, height: int, *, keys: Path | None = None) -> int:
    """Write the next published state as an SVG image.

    Raises:
        RunError: if no state arrives within ``wait_s`` seconds.
    """
    own = None if keys is None else load_client(keys)
    context = new_context()
    socket = subscribe(context, endpoint, own)
    try:
        envelope = receive(socket, wait_s)
    finally:
        socket.close(0)
        context.term()
    if envelope is None or not isinstance(envelope.message, DashboardState):
        raise RunError(_silence(endpoint, wait_s))
    export_svg(envelope.message, path, width, height)
    return 0


def _silence(endpoint: str, wait_s: float) -> str:
    return f"nothing was published at {endpoint} for {wait_s:.0f} s; is a coordinator running there (--connect)?"
