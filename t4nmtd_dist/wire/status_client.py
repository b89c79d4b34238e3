"""Status client, open to any authorised client; it can also add lines to the event log."""

from __future__ import annotations

import time

import zmq

from t4nmtd_dist.core.errors import ProtocolError, RunError
from t4nmtd_dist.wire.auth.handshake import HandshakeMonitor, Outcome, trouble
from t4nmtd_dist.wire.auth.keys import ClientKeys
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import Failure, Notice, Status, StatusRequest
from t4nmtd_dist.wire.sockets import connect, receive, send
from t4nmtd_dist.wire.zmq_types import Context

SENDER = "status"
POLL_S = 0.05


class StatusClient:
    """A client of a coordinator's control socket for status requests and notices.

    Args:
        keys: this client's, if the coordinator has keys.

    Raises:
        ConfigError: if the endpoint cannot be connected to.
    """

    def __init__(self, context: Context, endpoint: str, keys: ClientKeys | None = None) -> None:
        self._endpoint, self._keys = endpoint, keys
        self._socket = connect(context, endpoint, keys, monitored=True)
        self._handshakes = HandshakeMonitor(self._socket)
        self._number = 0

    def handshake(self, timeout_s: float) -> Outcome | None:
        """Wait for the handshake: ``agreed``, why it failed, or None after the timeout."""
        deadline = time.monotonic() + timeout_s
        last: Outcome | None = None
        while (left := deadline - time.monotonic()) > 0:
            outcome = self._handshakes.next(left)
            if outcome in ("agreed", "refused", "mechanism"):
                return outcome
            last = outcome if outcome == "broken" else last
        return last

    def status(self, timeout_s: float) -> Status:
        """Request the status over an established connection.

        Raises:
            ProtocolError: if the reply is invalid or a ``Failure``.
            RunError: if no reply comes in time.
        """
        deadline = time.monotonic() + timeout_s
        self._number += 1
        question = Envelope(StatusRequest(), {}, SENDER, self._number)
        if not self._socket.poll(int(timeout_s * 1000), zmq.POLLOUT) or not send(self._socket, question):
            raise RunError(f"no connection to {self._endpoint} any more")
        while (left := deadline - time.monotonic()) > 0:
            envelope = receive(self._socket, left)
            if envelope is None or envelope.id not in (0, self._number):
                continue
            if isinstance(envelope.message, Status):
                return envelope.message
            if isinstance(envelope.message, Failure):
                raise ProtocolError(envelope.message.text)
        raise RunError(f"{self._endpoint} accepted the question and did not answer within {timeout_s:.0f} s")

    def notify(self, text: str, timeout_s: float) -> None:
        """Add lines to the coordinator's event log; returns once they are read.

        Raises:
            ProtocolError: if they are rejected.
            RunError: if no reply comes in time.
        """
        if not send(self._socket, Envelope(Notice(text=text), {}, SENDER)):
            raise RunError(f"no connection to {self._endpoint} any more")
        self.status(timeout_s)  # same connection, so the reply follows the reading of the notice

    def close(self) -> None:
        """Close the connection."""
        self._handshakes.close()
        self._socket.close(0)


def send_notice(context: Context, endpoint: str, keys: ClientKeys | None, text: str, timeout_s: float) -> bool:
    """Add a text to a coordinator's event log; whether it was accepted in time.

    Raises:
        ConfigError: if the endpoint cannot be connected to.
    """
    client = StatusClient(context, endpoint, keys)
    try:
        if client.handshake(timeout_s) != "agreed":
            return False
        client.notify(text, timeout_s)
    except (RunError, ProtocolError):
        return False
    finally:
        client.close()
    return True


def ask_status(context: Context, endpoint: str, keys: ClientKeys | None, timeout_s: float) -> Status:
    """The status of the coordinator at an endpoint.

    Raises:
        ConfigError: if the endpoint cannot be connected to.
        ProtocolError: if the reply is invalid.
        RunError: if no reply comes; with the reason if known.
    """
    client = StatusClient(context, endpoint, keys)
    try:
        outcome = client.handshake(timeout_s)
        if outcome == "agreed":
            return client.status(timeout_s)
        silence = f"no coordinator answered at {endpoint} within {timeout_s:.0f} s; `t4nmtd doctor` finds out why"
        raise RunError(trouble(outcome, endpoint, keys) or silence)
    finally:
        client.close()
