"""Serves critic values, weights and experience to peers from its own thread.

The thread takes time from the learner, so it evaluates all waiting value requests of a sub-task in one call.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
import zmq
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import ProtocolError
from t4nmtd_dist.wire.addresses import LOOPBACK, split_endpoint
from t4nmtd_dist.wire.auth.allow_list import AllowedKeys
from t4nmtd_dist.wire.auth.keys import KeyPair
from t4nmtd_dist.wire.auth.zap import Authenticator, Refusal
from t4nmtd_dist.wire.codec import Envelope, with_prefix
from t4nmtd_dist.wire.connection_guard import ConnectionGuard
from t4nmtd_dist.wire.limits import CRITIC_LIMITS
from t4nmtd_dist.wire.messages import (
    ExperienceReply,
    ExperienceRequest,
    Failure,
    Message,
    ValueReply,
    ValueRequest,
    WeightsReply,
    WeightsRequest,
)
from t4nmtd_dist.wire.rate_limited_log import Log, RateLimitedLog
from t4nmtd_dist.wire.secure_receiver import Arrival, SecureReceiver
from t4nmtd_dist.wire.sockets import bind, bound_endpoint, send
from t4nmtd_dist.wire.zmq_types import Context

if TYPE_CHECKING:
    from t4nmtd_dist.agents.common.replay_buffer import ReplayBuffer
    from t4nmtd_dist.agents.protocol import PublishedValues

POLL_MS = 200
MESSAGES_PER_TURN = 200
STRANGER_S = 5.0
MOST_STRANGERS = 1000
WEIGHTS_EVERY_S = 0.5
EXPERIENCE_EVERY_S = 0.1
EXPERIENCE_BYTES = 1 << 20
REMEMBERED = 4096

Answer = tuple[Message, dict[str, NDArray[Any]]]


class _Pace:
    """Limits how often each connection gets a sub-task's data.

    Args:
        every_s: minimum interval in seconds.
    """

    def __init__(self, every_s: float) -> None:
        self.every_s = every_s
        self._last: OrderedDict[tuple[bytes, str], float] = OrderedDict()

    def is_early(self, peer: bytes, pid: str) -> bool:
        """Whether the interval has not yet passed."""
        return time.monotonic() - self._last.get((peer, pid), -np.inf) < self.every_s

    def note(self, peer: bytes, pid: str) -> None:
        """Record a delivery."""
        self._last[peer, pid] = time.monotonic()
        self._last.move_to_end((peer, pid))
        if len(self._last) > REMEMBERED:
            self._last.popitem(last=False)


class CriticService:
    """A ROUTER socket; ``serve`` publishes a sub-task's critic, ``allow`` sets the keys that may query it.

    Args:
        endpoint: where to listen.
        advertise: host advertised to peers; by default the bound one.
        insecure: allow an address beyond loopback without keys.
        own: this worker's pair; peers get its public half from the coordinator.
        tell: logs problems.

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
        tell: Log = lambda text: None,
    ) -> None:
        self._notices = RateLimitedLog(tell)
        self._strangers: dict[str, float] = {}
        self._allowed = None if own is None else AllowedKeys([own.public])
        self._own = own
        self._authenticator = (
            None if self._allowed is None else Authenticator(context, self._allowed, self._refused, for_good=False)
        )
        limits = CRITIC_LIMITS
        self._socket = bind(
            context,
            zmq.ROUTER,
            endpoint,
            insecure=insecure,
            own=own,
            frame_bytes=limits.frame_bytes,
            queued=limits.queued,
        )
        self._guard = ConnectionGuard(self._socket, limits, self._notices.log)
        self._receiver = SecureReceiver(self._socket, limits, self._allowed, self._notices.log, self._guard)
        host, port = split_endpoint(bound_endpoint(self._socket))
        self.endpoint = f"tcp://{advertise or host}:{port}"
        self._critics: dict[str, PublishedValues] = {}
        self._experiences: dict[str, ReplayBuffer] = {}
        self._weights_pace, self._experience_pace = _Pace(WEIGHTS_EVERY_S), _Pace(EXPERIENCE_EVERY_S)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._loop, name="critic-service", daemon=True)
        self._thread.start()

    def serve(self, pid: str, critic: PublishedValues, experience: ReplayBuffer | None = None) -> None:
        """Answer requests for ``pid`` from ``critic`` and ``experience`` from now on."""
        self._critics[pid] = critic
        if experience is not None:
            self._experiences[pid] = experience

    def allow(self, keys: Iterable[str]) -> None:
        """Allow only these keys and this worker's own from now on; no effect without keys."""
        if self._allowed is not None and self._own is not None:
            self._allowed.replace({*keys, self._own.public} - {""})

    def _refused(self, refusal: Refusal) -> None:
        """Log a rejected peer that keeps trying; a new peer may query early."""
        now = time.monotonic()
        if now - self._strangers.setdefault(refusal.key, now) >= STRANGER_S:
            text = f"refused a peer at {refusal.address}: its key {refusal.key} is none the coordinator told of"
            self._notices.log(text)
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
                self._take(list(self._receiver.arrivals(MESSAGES_PER_TURN)))
            self._receiver.disconnect_revoked()
        self._guard.close()
        self._socket.close(0)

    def _take(self, arrivals: Sequence[Arrival]) -> None:
        """Answer all waiting requests, value requests together."""
        asked: dict[str, list[tuple[bytes, Envelope]]] = {}
        for arrival in arrivals:
            peer, envelope = arrival.peer, arrival.content
            if isinstance(envelope, ProtocolError):
                send(self._socket, Envelope(Failure(text=str(envelope))), peer=peer)
            elif isinstance(envelope.message, ValueRequest):
                asked.setdefault(envelope.message.pid, []).append((peer, envelope))
            else:
                self._send(peer, envelope, self._other_answer(peer, envelope.message))
        for pid, requests in asked.items():
            answers = self._values(pid, [envelope for _, envelope in requests])
            for (peer, envelope), answer in zip(requests, answers, strict=True):
                self._send(peer, envelope, answer)

    def _send(self, peer: bytes, question: Envelope, answer: Answer) -> None:
        send(self._socket, Envelope(*answer, id=question.id), peer=peer)

    def _other_answer(self, peer: bytes, request: Message) -> Answer:
        if isinstance(request, ExperienceRequest):
            return self._experience(peer, request)
        if not isinstance(request, WeightsRequest):
            takes = "values, weights and experience"
            return Failure(text=f"a critic takes requests of {takes}, not {type(request).__name__}"), {}
        critic = self._critics.get(request.pid)
        if critic is None:
            return _no_critic(request.pid)
        return self._weights(peer, request, critic)

    def _weights(self, peer: bytes, request: WeightsRequest, critic: PublishedValues) -> Answer:
        """The newest weights, at most twice a second per connection."""
        if self._weights_pace.is_early(peer, request.pid):
            return _early("weights", request.pid, self._weights_pace)
        weights, version = critic.weights()
        if version <= request.newer_than:
            return WeightsReply(version=version), {}
        self._weights_pace.note(peer, request.pid)
        return WeightsReply(version=version), with_prefix("weights.", weights)

    def _experience(self, peer: bytes, request: ExperienceRequest) -> Answer:
        """Steps from the requested one that fit into a message, at most ten times a second per connection."""
        experience = self._experiences.get(request.pid)
        if experience is None:
            return Failure(text=f"no experience of {request.pid!r} here"), {}
        if self._experience_pace.is_early(peer, request.pid):
            return _early("experience", request.pid, self._experience_pace)
        self._experience_pace.note(peer, request.pid)
        first, columns = experience.since(request.step, EXPERIENCE_BYTES)
        reply = ExperienceReply(first=first, written=experience.written, origin=experience.origin)
        return reply, with_prefix("experience.", columns)

    def _values(self, pid: str, requests: Sequence[Envelope]) -> list[Answer]:
        """Answers to one sub-task's value requests, from one evaluation if possible."""
        critic = self._critics.get(pid)
        if critic is None:
            return [_no_critic(pid)] * len(requests)
        if len(requests) > 1:
            with suppress(ProtocolError, ValueError, KeyError, TypeError):  # on error, answer one by one
                return _together(critic, requests)
        return [_alone(critic, request) for request in requests]


def _early(what: str, pid: str, pace: _Pace) -> Answer:
    return Failure(text=f"{what} of {pid!r} went to you less than {pace.every_s} s ago"), {}


def _no_critic(pid: str) -> Answer:
    return Failure(text=f"no critic of {pid!r} here"), {}


def _alone(critic: PublishedValues, request: Envelope) -> Answer:
    if request.arrays.get("q", np.empty(0)).ndim != 1:
        return Failure(text="a value request needs q of one dimension"), {}
    try:
        values, version = critic.values(request.arrays)
    except ProtocolError as error:
        return Failure(text=str(error)), {}
    return ValueReply(version=version), {"value": values}


def _together(critic: PublishedValues, requests: Sequence[Envelope]) -> list[Answer]:
    """One evaluation for all requests.

    Raises:
        ProtocolError: if one of them is invalid.
        ValueError: likewise.
        KeyError: likewise.
    """
    lengths = [len(request.arrays["q"]) for request in requests]
    if [len(request.arrays["observation"]) for request in requests] != lengths:
        raise ProtocolError("every request needs as many observations as DFA states")
    names = ("observation", "q")
    arrays = {name: np.concatenate([request.arrays[name] for request in requests]) for name in names}
    values, version = critic.values(arrays)
    parts = np.split(values, np.cumsum(lengths)[:-1])
    return [(ValueReply(version=version), {"value": part}) for part in parts]
