"""ZeroMQ sockets with bounded queues, bounded messages and no indefinite blocking."""

from __future__ import annotations

import ipaddress

import zmq

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.wire.auth.keys import ClientKeys, KeyPair
from t4nmtd_dist.wire.codec import MAX_ARRAY_BYTES, Envelope, decode, encode
from t4nmtd_dist.wire.endpoints import check_endpoint
from t4nmtd_dist.wire.zmq_types import MONITORED, Context, Socket

QUEUED_MESSAGES = 1000
ENCRYPTION_BYTES = 64  # upper bound on what CURVE adds to a frame
HANDSHAKE_MS = 10_000


def _prepare(context: Context, kind: int, frame_bytes: int = MAX_ARRAY_BYTES, queued: int = QUEUED_MESSAGES) -> Socket:
    socket = context.socket(kind)
    socket.setsockopt(zmq.LINGER, 500)
    socket.setsockopt(zmq.SNDHWM, queued)
    socket.setsockopt(zmq.RCVHWM, QUEUED_MESSAGES)
    socket.setsockopt(zmq.MAXMSGSIZE, frame_bytes + ENCRYPTION_BYTES)
    socket.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
    return socket


def bind(
    context: Context,
    kind: int,
    endpoint: str,
    *,
    insecure: bool = False,
    own: KeyPair | None = None,
    frame_bytes: int = MAX_ARRAY_BYTES,
    queued: int = QUEUED_MESSAGES,
) -> Socket:
    """Bind a ROUTER or XPUB socket.

    Args:
        context: the process's context.
        kind: ``zmq.ROUTER`` or ``zmq.XPUB``.
        endpoint: ``tcp://ADDRESS:PORT``; port ``*`` takes any free one.
        insecure: allow binding without keys beyond loopback.
        own: the socket's key pair; the context's ``Authenticator`` decides who may connect.
        frame_bytes: the largest accepted frame.
        queued: maximum send queue per connection, in messages.

    Raises:
        ConfigError: if the endpoint is malformed, unavailable, or beyond loopback without keys.
    """
    check_endpoint(endpoint)
    if not insecure and own is None and not on_loopback(endpoint):
        raise ConfigError(
            f"{endpoint} can be reached from other machines; pass --keys DIR (`t4nmtd keys new DIR` makes them), "
            "bind to 127.0.0.1, or pass --insecure if all of the network is trusted"
        )
    socket = _prepare(context, kind, frame_bytes, queued)
    if own is not None:
        _serve_keys(socket, own)
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


def _serve_keys(socket: Socket, own: KeyPair) -> None:
    socket.setsockopt(zmq.CURVE_SERVER, 1)
    socket.setsockopt(zmq.CURVE_PUBLICKEY, own.public.encode())
    socket.setsockopt(zmq.CURVE_SECRETKEY, own.secret.encode())
    socket.setsockopt(zmq.ZAP_DOMAIN, b"t4nmtd")
    socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)  # without an authenticator, reject all instead of accepting all


def _present_keys(socket: Socket, keys: ClientKeys) -> None:
    socket.setsockopt(zmq.CURVE_SERVERKEY, keys.server.encode())
    socket.setsockopt(zmq.CURVE_PUBLICKEY, keys.own.public.encode())
    socket.setsockopt(zmq.CURVE_SECRETKEY, keys.own.secret.encode())


def bound_endpoint(socket: Socket) -> str:
    """The endpoint a socket listens at, with its actual port."""
    endpoint = socket.getsockopt(zmq.LAST_ENDPOINT)
    assert isinstance(endpoint, bytes)
    return endpoint.decode()


def connect(
    context: Context,
    endpoint: str,
    keys: ClientKeys | None = None,
    *,
    handshake_ms: int = HANDSHAKE_MS,
    monitored: bool = False,
) -> Socket:
    """Connect a DEALER that queues nothing while its peer is away.

    Args:
        context: the process's context.
        endpoint: ``tcp://HOST:PORT``.
        keys: this client's pair and the server's public key.
        handshake_ms: timeout of a handshake attempt.
        monitored: record events from the start for a ``HandshakeMonitor``.

    Raises:
        ConfigError: if the endpoint is malformed or cannot be connected to.
    """
    check_endpoint(endpoint)
    socket = _prepare(context, zmq.DEALER)
    socket.setsockopt(zmq.IMMEDIATE, 1)
    socket.setsockopt(zmq.HANDSHAKE_IVL, handshake_ms)
    return _connected(socket, endpoint, keys, monitored)


def _connected(socket: Socket, endpoint: str, keys: ClientKeys | None, monitored: bool) -> Socket:
    if keys is not None:
        _present_keys(socket, keys)
    if monitored:
        socket.get_monitor_socket(MONITORED)
    try:
        socket.connect(endpoint)
    except zmq.ZMQError as error:
        socket.close(0)
        raise ConfigError(f"cannot connect to {endpoint}: {error}") from None
    return socket


def subscribe(context: Context, endpoint: str, keys: ClientKeys | None = None, *, monitored: bool = False) -> Socket:
    """A SUB socket for everything an XPUB publishes; ``keys`` and ``monitored`` as for ``connect``.

    Raises:
        ConfigError: if the endpoint is malformed or cannot be connected to.
    """
    check_endpoint(endpoint)
    socket = _prepare(context, zmq.SUB)
    socket.setsockopt(zmq.SUBSCRIBE, b"")
    return _connected(socket, endpoint, keys, monitored)


def on_loopback(endpoint: str) -> bool:
    """Whether only this machine can reach an endpoint."""
    host = endpoint.partition("://")[2].rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def send(socket: Socket, envelope: Envelope, *, peer: bytes | None = None) -> bool:
    """Send without blocking; False if the peer is away or its queue is full.

    Raises:
        ProtocolError: see ``encode``.
    """
    frames = encode(envelope)
    return send_frames(socket, frames if peer is None else [peer, *frames])


def send_frames(socket: Socket, frames: list[bytes]) -> bool:
    """Send an encoded message; returns as ``send``."""
    try:
        socket.send_multipart(frames, flags=zmq.NOBLOCK)
    except zmq.Again:
        return False
    except zmq.ZMQError as error:
        if error.errno == zmq.EHOSTUNREACH:
            return False
        raise
    return True


def receive(socket: Socket, timeout_s: float) -> Envelope | None:
    """The next message of a DEALER or SUB; None after ``timeout_s`` seconds.

    Raises:
        ProtocolError: if it violates the protocol.
    """
    if not socket.poll(int(timeout_s * 1000)):
        return None
    return decode(socket.recv_multipart())
