"""How connections begin: why one could not be agreed upon, as libzmq's monitor tells it on either side."""

from __future__ import annotations

from typing import Literal

import zmq
from zmq.utils.monitor import recv_monitor_message

from t4nmtd_dist.wire.sockets import Socket

Outcome = Literal["connected", "agreed", "refused", "mechanism", "broken", "ended"]

_EVENTS = (
    zmq.EVENT_CONNECTED
    | zmq.EVENT_HANDSHAKE_SUCCEEDED
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_DISCONNECTED
)
_OUTCOMES: dict[int, Outcome] = {
    zmq.EVENT_CONNECTED: "connected",
    zmq.EVENT_HANDSHAKE_SUCCEEDED: "agreed",
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: "refused",
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: "broken",
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL: "broken",
    zmq.EVENT_DISCONNECTED: "ended",
}


class HandshakeMonitor:
    """What becomes of a socket's connections; make it before messages are expected.

    Outcomes are: ``connected`` (TCP only), ``agreed``, ``refused`` (the key is not on the other side's list),
    ``mechanism`` (one side has keys and the other has not), ``broken`` (closed or not understood in between, as when
    the other side's key is not the expected one), and ``ended``.

    Args:
        socket: any socket; the monitor must be closed before it.
    """

    def __init__(self, socket: Socket) -> None:
        self._socket = socket
        self._monitor: Socket = socket.get_monitor_socket(_EVENTS)

    def next(self, timeout_s: float = 0.0) -> Outcome | None:
        """The next outcome, or None after ``timeout_s``."""
        if not self._monitor.poll(int(timeout_s * 1000)):
            return None
        event = recv_monitor_message(self._monitor)
        if event["value"] == zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH and _is_protocol(event["event"]):
            return "mechanism"
        return _OUTCOMES.get(int(event["event"]))

    def close(self) -> None:
        """Stop watching."""
        self._socket.disable_monitor()


def _is_protocol(event: int) -> bool:
    return event == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
