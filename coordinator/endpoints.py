"""The coordinator's two bound sockets and their access control."""

from __future__ import annotations

from collections.abc import Iterator, Set
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue

import zmq

from t4nmtd_dist.wire.auth.allow_list import AllowedFolder
from t4nmtd_dist.wire.auth.keys import ClientKeys, KeyPair, load_coordinator
from t4nmtd_dist.wire.auth.zap import Authenticator, Refusal
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.connection_guard import ConnectionGuard
from t4nmtd_dist.wire.limits import CONTROL_LIMITS, STATE_LIMITS, Limits
from t4nmtd_dist.wire.rate_limited_log import RateLimitedLog
from t4nmtd_dist.wire.secure_receiver import Arrival, SecureReceiver
from t4nmtd_dist.wire.sockets import bind, bound_endpoint, send
from t4nmtd_dist.wire.zmq_types import Context, Socket, new_context

MESSAGES_PER_TURN = 200


@dataclass(frozen=True)
class Access:
    """The coordinator's endpoints and access control.

    Attributes:
        control: endpoint for workers.
        publish: endpoint that publishes the state.
        keys: the coordinator's key folder; None for loopback or ``insecure``.
        insecure: allow addresses beyond loopback without keys.
    """

    control: str
    publish: str
    keys: Path | None = None
    insecure: bool = False


class BoundSockets:
    """Binds both sockets, with keys if given; use from one thread.

    Raises:
        ConfigError: if an endpoint cannot be used.
        KeyFileError: if the keys cannot be used.
    """

    def __init__(self, access: Access) -> None:
        self._noticed: SimpleQueue[str] = SimpleQueue()
        self._notices = RateLimitedLog(self._noticed.put)
        self._own: KeyPair | None = None
        self._allowed: AllowedFolder | None = None
        self._acted_upon: Set[str] = frozenset()
        self._authenticator: Authenticator | None = None
        self._guards: list[ConnectionGuard] = []
        with ExitStack() as undo:
            self._context: Context = new_context()
            undo.callback(self._context.destroy, 0)
            undo.callback(self._close_guards)
            if access.keys is not None:
                self._authenticator = self._open_authenticator(access.keys)
                undo.callback(self._authenticator.close)
            self._control, self._control_receiver = self._bind(
                zmq.ROUTER, access.control, access.insecure, CONTROL_LIMITS
            )
            self._publisher, self._state_receiver = self._bind(zmq.XPUB, access.publish, access.insecure, STATE_LIMITS)
            undo.pop_all()
        self.control, self.publish = bound_endpoint(self._control), bound_endpoint(self._publisher)
        self._poller = zmq.Poller()
        self._poller.register(self._control, zmq.POLLIN)
        self._poller.register(self._publisher, zmq.POLLIN)

    @property
    def own_keys(self) -> ClientKeys | None:
        """Keys for this process's own dashboard."""
        return None if self._own is None else ClientKeys(self._own, self._own.public)

    def _open_authenticator(self, keys: Path) -> Authenticator:
        self._own = load_coordinator(keys)
        self._allowed = AllowedFolder(keys, self._own.public, self._notices.log)
        self._acted_upon = self._allowed.all()
        return Authenticator(self._context, self._allowed, self._refused)

    def _refused(self, refusal: Refusal) -> None:
        self._notices.log(f"refused a client at {refusal.address}: its key {refusal.key} is not on the list")

    def _bind(self, kind: int, endpoint: str, insecure: bool, limits: Limits) -> tuple[Socket, SecureReceiver]:
        socket = bind(
            self._context,
            kind,
            endpoint,
            insecure=insecure,
            own=self._own,
            frame_bytes=limits.frame_bytes,
            queued=limits.queued,
        )
        where = bound_endpoint(socket)
        guard = ConnectionGuard(
            socket, limits, lambda text: self._notices.log(f"{where}: {text}"), lambda _: self._not_agreed(where)
        )
        self._guards.append(guard)
        return socket, SecureReceiver(socket, limits, self._allowed, self._notices.log, guard)

    def _not_agreed(self, where: str) -> None:
        if self._own is not None:
            self._notices.log(f"refused a client at {where}: it has no key, or not this coordinator's public key")

    def wait(self, seconds: float) -> tuple[bool, bool]:
        """Wait for input; whether messages and whether subscriptions arrived."""
        ready = dict(self._poller.poll(int(seconds * 1000)))
        return self._control in ready, self._publisher in ready

    def arrivals(self) -> Iterator[Arrival]:
        """The waiting messages of allowed senders."""
        return self._control_receiver.arrivals(MESSAGES_PER_TURN)

    def subscribed(self) -> bool:
        """Read the state socket; whether an allowed client subscribed."""
        return self._state_receiver.subscribed(MESSAGES_PER_TURN)

    def answer(self, peer: bytes, envelope: Envelope) -> None:
        """Send to one peer."""
        send(self._control, envelope, peer=peer)

    def broadcast(self, envelope: Envelope) -> None:
        """Send to all subscribers."""
        send(self._publisher, envelope)

    def changed_keys(self) -> Set[str] | None:
        """All allowed keys if the list has changed, else None; ends the connections of removed keys."""
        if self._allowed is None:
            return None
        self._allowed.refresh()  # the authenticator's thread refreshes too: only one of the two sees a change
        allowed = self._allowed.all()
        if allowed == self._acted_upon:
            return None
        self._acted_upon = allowed
        self._control_receiver.disconnect_revoked()
        self._state_receiver.disconnect_revoked()
        return allowed

    def notices(self) -> Iterator[str]:
        """Lines about problems since the last call."""
        while True:
            try:
                yield self._noticed.get_nowait()
            except Empty:
                return

    def _close_guards(self) -> None:
        while self._guards:
            self._guards.pop().close()

    def close(self) -> None:
        """Close both sockets; sent messages have half a second to leave."""
        self._close_guards()
        self._control.close(500)
        self._publisher.close(500)
        if self._authenticator is not None:
            self._authenticator.close()
        self._context.term()
