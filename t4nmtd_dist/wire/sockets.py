"""ZeroMQ sockets as this project uses them: bounded queues, bounded messages, nothing that blocks for ever."""

from __future__ import annotations

import ipaddress

import zmq

from t4nmtd_dist.errors import ConfigError, ProtocolError
from t4nmtd_dist.wire.codec import MAX_ARRAY_BYTES, Envelope, decode, encode
from t4nmtd_dist.wire.endpoints import check_endpoint

QUEUED_MESSAGES = 1000

Socket = zmq.Socket[bytes]
Context = zmq.Context[Socket]


def new_context() -> Context:
    """A context of one's own (one per process)."""
    return zmq.Context()


def _prepare(context: Context, kind: int) -> Socket:
    socket = context.socket(kind)
    socket.setsockopt(zmq.LINGER, 500)
    socket.setsockopt(zmq.SNDHWM, QUEUED_MESSAGES)
    socket.setsockopt(zmq.RCVHWM, QUEUED_MESSAGES)
    socket.setsockopt(zmq.MAXMSGSIZE, MAX_ARRAY_BYTES)
    return socket


def bind(context: Context, kind: int, endpoint: str, *, insecure: bool = False) -> Socket:
    """A bound ROUTER or XPUB socket.

    Args:
        context: the process's context.
        kind: ``zmq.ROUTER`` or ``zmq.XPUB``.
        endpoint: ``tcp://ADDRESS:PORT``; port ``*`` takes any free one.
        insecure: allow an address that other machines can reach.

    Raises:
        ConfigError: if the port is in use, the endpoint is malformed, or it is not on loopback.
    """
    check_endpoint(endpoint)
    if not insecure and not _on_loopback(endpoint):
        raise ConfigError(
            f"{endpoint} can be reached from other machines; "
            "bind to 127.0.0.1, or pass --insecure if the network is trusted"
        )
    socket = _prepare(context, kind)
    if kind == zmq.XPUB:
        socket.setsockopt(zmq.XPUB_VERBOSE, 1)
    try:
        socket.bind(endpoint)
    except zmq.ZMQError as error:
        socket.close(0)
        if error.errno == zmq.EADDRINUSE:
            raise ConfigError(f"{endpoint} is in use; stop what listens there, or choose another address") from None
        raise ConfigError(f"cannot listen at {endpoint}: {error}") from None
    return socket


def bound_endpoint(socket: Socket) -> str:
    """Where a socket really listens (its port is known even if ``*`` was asked for)."""
    endpoint = socket.getsockopt(zmq.LAST_ENDPOINT)
    assert isinstance(endpoint, bytes)
    return endpoint.decode()


def connect(context: Context, endpoint: str) -> Socket:
    """A connected DEALER that queues nothing while its peer is away.

    Raises:
        ConfigError: if the endpoint is malformed or cannot be connected to.
    """
    check_endpoint(endpoint)
    socket = _prepare(context, zmq.DEALER)
    socket.setsockopt(zmq.IMMEDIATE, 1)
    return _connected(socket, endpoint)


def _connected(socket: Socket, endpoint: str) -> Socket:
    try:
        socket.connect(endpoint)
    except zmq.ZMQError as error:
        socket.close(0)
        raise ConfigError(f"cannot connect to {endpoint}: {error}") from None
    return socket


def subscribe(context: Context, endpoint: str) -> Socket:
    """A SUB socket for everything that an XPUB publishes.

    Raises:
        ConfigError: if the endpoint is malformed or cannot be connected to.
    """
    check_endpoint(endpoint)
    socket = _prepare(context, zmq.SUB)
    socket.setsockopt(zmq.SUBSCRIBE, b"")
    return _connected(socket, endpoint)


def _on_loopback(endpoint: str) -> bool:
    host = endpoint.partition("://")[2].rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def send(socket: Socket, envelope: Envelope, *, peer: bytes | None = None) -> bool:
    """Send a message without waiting; False if the other side is away or does not take any more."""
    frames = encode(envelope)
    try:
        socket.send_multipart(frames if peer is None else [peer, *frames], flags=zmq.NOBLOCK)
    except zmq.Again:
        return False
    except zmq.ZMQError as error:
        if error.errno == zmq.EHOSTUNREACH:
            return False
        raise
    return True


def receive(socket: Socket, timeout_s: float) -> Envelope | None:
    """The next message of a DEALER or SUB, or None after ``timeout_s``.

    Raises:
        ProtocolError: if it does not follow the protocol.
    """
    if not socket.poll(int(timeout_s * 1000)):
        return None
    return decode(socket.recv_multipart())


def receive_from(socket: Socket) -> tuple[bytes, Envelope | ProtocolError] | None:
    """The next message waiting at a ROUTER with its sender; None if there is none.

    A malformed message comes back as the error that describes it, so that its sender can be told.
    """
    try:
        peer, *frames = socket.recv_multipart(flags=zmq.NOBLOCK)
    except zmq.Again:
        return None
    try:
        return peer, decode(frames)
    except ProtocolError as error:
        return peer, error
