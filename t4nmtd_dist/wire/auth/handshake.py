"""Handshake outcomes, from libzmq's monitor events on either side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import zmq
from zmq.utils.monitor import recv_monitor_message

from t4nmtd_dist.wire.auth.keys import ClientKeys
from t4nmtd_dist.wire.zmq_types import MONITORED, Socket

Outcome = Literal["connected", "agreed", "refused", "mechanism", "broken", "ended"]

_OUTCOMES: dict[int, Outcome] = {
    zmq.EVENT_CONNECTED: "connected",
    zmq.EVENT_HANDSHAKE_SUCCEEDED: "agreed",
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: "refused",
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: "broken",
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL: "broken",
    zmq.EVENT_DISCONNECTED: "ended",
}


class HandshakeMonitor:
    """Reports the outcomes of a socket's handshakes.

    Outcomes are ``connected`` (TCP only), ``agreed``, ``refused`` (key not on the server's list), ``mechanism`` (only
    one side has keys), ``broken`` (failed otherwise, for instance because of a wrong server key), and ``ended``.

    Args:
        socket: a bound socket, or one connected with ``monitored``; close the monitor first.
    """

    def __init__(self, socket: Socket) -> None:
        self._socket = socket
        self._monitor: Socket = socket.get_monitor_socket(MONITORED)

    def next(self, timeout_s: float = 0.0) -> Outcome | None:
        """The next outcome, or None after ``timeout_s`` seconds."""
        if not self._monitor.poll(int(timeout_s * 1000)):
            return None
        return outcome_of(recv_monitor_message(self._monitor))

    def close(self) -> None:
        """Stop watching."""
        self._socket.disable_monitor()
        self._monitor.close(0)


def outcome_of(event: Mapping[str, Any]) -> Outcome | None:
    """The outcome that a libzmq monitor event reports, if any."""
    is_protocol = event["event"] == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    if is_protocol and event["value"] == zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH:
        return "mechanism"
    return _OUTCOMES.get(int(event["event"]))


def trouble(outcome: Outcome | None, endpoint: str, keys: ClientKeys | None) -> str | None:
    """Why a coordinator cannot be reached and what to do; None if no fault is known.

    Args:
        outcome: of the handshake.
        endpoint: of the coordinator.
        keys: this client's.
    """
    if outcome == "refused" and keys is not None:
        return (
            f"the coordinator at {endpoint} refused the key of {keys.own.name} ({keys.own.public}): it is not on its "
            "list, or was taken off; there, `t4nmtd keys list DIR` shows the list and `t4nmtd keys add` adds to it"
        )
    if outcome == "mechanism" and keys is None:
        return f"the coordinator at {endpoint} takes only clients with keys; pass --keys DIR (docs/security.md)"
    if outcome == "mechanism":
        return f"what listens at {endpoint} has no keys; start it with --keys if it is the right one, or leave them out"
    if outcome == "broken" and keys is not None:
        return (
            f"no connection could be agreed upon with {endpoint}: its key is not {keys.server}, "
            "as coordinator.public in the --keys folder says, or it is not a control port"
        )
    if outcome == "broken":
        return f"no connection could be agreed upon with {endpoint}: it needs --keys, or is not a control port"
    return None
