"""Answers ZeroMQ's authentication requests (ZAP, ZeroMQ RFC 27) in its own thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

import zmq
from zmq.utils import z85

from t4nmtd_dist.wire.auth.allow_list import AllowedFolder, AllowedKeys
from t4nmtd_dist.wire.zmq_types import Context, Socket

ENDPOINT = "inproc://zeromq.zap.01"
POLL_MS = 200
FOR_GOOD, FOR_NOW = b"400", b"300"


@dataclass(frozen=True)
class Refusal:
    """A client whose key is not allowed."""

    socket: str
    address: str
    key: str


class Authenticator:
    """Admits listed clients to all sockets of a context; create it before binding.

    ZeroMQ checks keys only in the handshake; ``wire.secure_receiver`` handles later revocations.

    Args:
        allowed: the list.
        refused: called in the authenticator's thread for every rejected client.
        for_good: tell rejected clients to give up rather than retry.
    """

    def __init__(
        self, context: Context, allowed: AllowedKeys, refused: Callable[[Refusal], None], *, for_good: bool = True
    ) -> None:
        self._allowed, self._refused = allowed, refused
        self._refusal = FOR_GOOD if for_good else FOR_NOW
        self._socket: Socket = context.socket(zmq.REP)
        self._socket.bind(ENDPOINT)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._loop, name="authenticator", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop admitting clients; returns within a second."""
        self._stop.set()
        self._thread.join(timeout=1.0)

    def _loop(self) -> None:
        try:
            while not self._stop.is_set():
                if self._socket.poll(POLL_MS):
                    self._socket.send_multipart(self._answer(self._socket.recv_multipart()))
        finally:
            self._socket.close(0)

    def _answer(self, question: list[bytes]) -> list[bytes]:
        """Answer: version, number, domain, address, routing id, mechanism, key (32 bytes)."""
        version, number, domain, address, _, mechanism, *credentials = question
        key = z85.encode(credentials[0]).decode() if mechanism == b"CURVE" and len(credentials) == 1 else ""
        if isinstance(self._allowed, AllowedFolder):
            self._allowed.refresh()
        if key and key in self._allowed:
            return [version, number, b"200", b"OK", key.encode(), b""]
        self._refused(Refusal(domain.decode(errors="replace"), address.decode(errors="replace"), key))
        return [version, number, self._refusal, b"this key is not on the list", b"", b""]
