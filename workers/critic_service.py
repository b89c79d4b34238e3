"""Answers peers' critic requests from published copies of the networks, in a thread of its own."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import numpy as np
import zmq

from t4nmtd_dist.errors import ProtocolError
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import Failure, Message, ValueReply, ValueRequest
from t4nmtd_dist.wire.sockets import Context, bind, bound_endpoint, receive_from, send

if TYPE_CHECKING:
    from t4nmtd_dist.learners.ppo import PublishedCritic

POLL_MS = 200


class CriticService:
    """A ROUTER socket on a free port; ``serve`` publishes the critic of a sub-task.

    Args:
        context: the process's ZeroMQ context.
        host: address to listen on.
        insecure: allow an address that other machines can reach.
    """

    def __init__(self, context: Context, host: str = "127.0.0.1", *, insecure: bool = False) -> None:
        self._socket = bind(context, zmq.ROUTER, f"tcp://{host}:*", insecure=insecure)
        self.endpoint = bound_endpoint(self._socket)
        self._critics: dict[str, PublishedCritic] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._loop, name="critic-service", daemon=True)
        self._thread.start()

    def serve(self, pid: str, critic: PublishedCritic) -> None:
        """Answer requests for ``pid`` from ``critic`` from now on."""
        self._critics[pid] = critic

    def close(self) -> None:
        """Stop answering; returns within a second."""
        self._stop.set()
        self._thread.join(timeout=1.0)

    def _loop(self) -> None:
        while not self._stop.is_set():
            if self._socket.poll(POLL_MS):
                self._answer_waiting()
        self._socket.close(0)

    def _answer_waiting(self) -> None:
        while (received := receive_from(self._socket)) is not None:
            peer, envelope = received
            if isinstance(envelope, ProtocolError):
                send(self._socket, Envelope(Failure(text=str(envelope))), peer=peer)
                continue
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
