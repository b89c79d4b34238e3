"""Answers peers' critic requests from published copies of the networks, in a thread of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
import zmq

from t4nmtd_dist.errors import ProtocolError
from t4nmtd_dist.wire.addresses import LOOPBACK, split_endpoint
from t4nmtd_dist.wire.allow_list import AllowedKeys
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.gate import Arrival, Gate
from t4nmtd_dist.wire.keys import KeyPair
from t4nmtd_dist.wire.limits import CRITIC_LIMITS
from t4nmtd_dist.wire.messages import Failure, Message, ValueReply, ValueRequest
from t4nmtd_dist.wire.notices import Notices, Tell
from t4nmtd_dist.wire.sockets import Context, bind, bound_endpoint, send
from t4nmtd_dist.wire.zap import Authenticator, Refusal

if TYPE_CHECKING:
    from t4nmtd_dist.learners.protocol import PublishedValues

POLL_MS = 200
MESSAGES_PER_TURN = 200
STRANGER_S = 5.0
MOST_STRANGERS = 1000


class CriticService:
    """A ROUTER socket; ``serve`` publishes the critic of a sub-task, ``allow`` says which keys may ask.

    Args:
        context: the process's ZeroMQ context.
        endpoint: where to listen.
        advertise: host under which peers find it; the bound one by default.
        insecure: allow an address that other machines can reach without keys.
        own: this worker's pair; peers know its public half from the coordinator.
        tell: called with a line about trouble.

    Raises:
        ConfigError: if the endpoint cannot be used.
    """

    def __init__(
        self,
        context: Context,
        endpoint: str = f"tcp://{LOOPBACK}:*",
        *,
        advertise: str = "",
        insecure: bool = False,
        own: KeyPair | None = None,
        tell: Tell = lambda text: None,
    ) -> None:
        self._notices = Notices(tell)
        self._strangers: dict[str, float] = {}
        self._allowed = None if own is None else AllowedKeys([own.public])
        self._own = own
        self._authenticator = (
            None if self._allowed is None else Authenticator(context, self._allowed, self._refused, for_good=False)
        )
        limits = CRITIC_LIMITS
        self._socket = bind(context, zmq.ROUTER, endpoint, insecure=insecure, own=own, frame_bytes=limits.frame_bytes)
        self._gate = Gate(self._socket, limits, self._allowed, self._notices.once)
        host, port = split_endpoint(bound_endpoint(self._socket))
        self.endpoint = f"tcp://{advertise or host}:{port}"
        self._critics: dict[str, PublishedValues] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._loop, name="critic-service", daemon=True)
        self._thread.start()

    def serve(self, pid: str, critic: PublishedValues) -> None:
        """Answer requests for ``pid`` from ``critic`` from now on."""
        self._critics[pid] = critic

    def allow(self, keys: Iterable[str]) -> None:
        """Let these keys ask, and this worker's own, and no others from now on; nothing to do without keys."""
        if self._allowed is not None and self._own is not None:
            self._allowed.replace({*keys, self._own.public} - {""})

    def _refused(self, refusal: Refusal) -> None:
        """A peer may well ask before this worker has heard of it: worth telling only if that goes on."""
        now = time.monotonic()
        if now - self._strangers.setdefault(refusal.key, now) >= STRANGER_S:
            text = f"refused a peer at {refusal.address}: its key {refusal.key} is none the coordinator told of"
            self._notices.once(text)
        if len(self._strangers) > MOST_STRANGERS:
            self._strangers.clear()

    def close(self) -> None:
        """Stop answering; returns within two seconds."""
        self._stop.set()
        self._thread.join(timeout=1.0)
        if self._authenticator is not None:
            self._authenticator.close()

    def _loop(self) -> None:
        while not self._stop.is_set():
            if self._socket.poll(POLL_MS):
                for arrival in self._gate.arrivals(MESSAGES_PER_TURN):
                    self._take(arrival)
            self._gate.expel()
        self._socket.close(0)

    def _take(self, arrival: Arrival) -> None:
        peer, envelope = arrival.peer, arrival.content
        if isinstance(envelope, ProtocolError):
            send(self._socket, Envelope(Failure(text=str(envelope))), peer=peer)
            return
        message, arrays = self._answer(envelope)
        send(self._socket, Envelope(message, arrays, id=envelope.id), peer=peer)

    def _answer(
        self, envelope: Envelope
    ) -> tuple[Message, dict[str, np.ndarray[tuple[int, ...], np.dtype[np.float32]]]]:
        request = envelope.message
        if not isinstance(request, ValueRequest):
            return Failure(text=f"a critic takes value requests, not {type(request).__name__}"), {}
        critic = self._critics.get(request.pid)
        if critic is None:
            return Failure(text=f"no critic of {request.pid!r} here"), {}
        if envelope.arrays.get("q", np.empty(0)).ndim != 1:
            return Failure(text="a value request needs q of one dimension"), {}
        try:
            values, version = critic.values(envelope.arrays)
        except ProtocolError as error:
            return Failure(text=str(error)), {}
        return ValueReply(version=version), {"value": values}
