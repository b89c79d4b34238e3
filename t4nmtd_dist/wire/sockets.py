"""ZeroMQ sockets as this project uses them: bounded queues, bounded messages, nothing that blocks for ever."""

from __future__ import annotations

import ipaddress

import zmq

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.wire.auth.keys import ClientKeys, KeyPair
from t4nmtd_dist.wire.codec import MAX_ARRAY_BYTES, Envelope, decode, encode
from t4nmtd_dist.wire.endpoints import check_endpoint
from t4nmtd_dist.wire.zmq_types import MONITORED, Context, Socket

QUEUED_MESSAGES = 1000
ENCRYPTION_BYTES = 64  # what CURVE adds to a frame, generously
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
    """A bound ROUTER or XPUB socket.

    Args:
        context: the process's context.
        kind: ``zmq.ROUTER`` or ``zmq.XPUB``.
        endpoint: ``tcp://ADDRESS:PORT``; port ``*`` takes any free one.
        insecure: allow an address that other machines can reach without keys.
        own: the pair by which clients know this socket; an ``Authenticator`` of the context decides who gets in.
        frame_bytes: the largest frame taken.
        queued: most messages that wait to be sent over one connection.

    Raises:
        ConfigError: if the port is in use, the endpoint is malformed, or it is not on loopback and has no keys.
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
    socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)  # without an authenticator nobody gets in, instead of everybody


def _present_keys(socket: Socket, keys: ClientKeys) -> None:
    socket.setsockopt(zmq.CURVE_SERVERKEY, keys.server.encode())
    socket.setsockopt(zmq.CURVE_PUBLICKEY, keys.own.public.encode())
    socket.setsockopt(zmq.CURVE_SECRETKEY, keys.own.secret.encode())


def bound_endpoint(socket: Socket) -> str:
    """Where a socket really listens (its port is known even if ``*`` was asked for)."""
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
    """A connected DEALER that queues nothing while its peer is away.

    Args:
        context: the process's context.
        endpoint: ``tcp://HOST:PORT``.
        keys: what to prove oneself by, and the key that the other side must have.
        handshake_ms: how long to wait for an answer to the handshake before trying again.
        monitored: keep what happens from the first moment for a ``HandshakeMonitor``.

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
    """A SUB socket for everything that an XPUB publishes; ``keys`` and ``monitored`` as for ``connect``.

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
    """Send a message without waiting; False if the other side is away or does not take any more."""
    frames = encode(envelope)
    return send_frames(socket, frames if peer is None else [peer, *frames])


def send_frames(socket: Socket, frames: list[bytes]) -> bool:
    """Send a message that is encoded already; the result as of ``send``."""
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
    """The next message of a DEALER or SUB, or None after ``timeout_s``.

    Raises:
        ProtocolError: if it does not follow the protocol.
    """
    if not socket.poll(int(timeout_s * 1000)):
        return None
    return decode(socket.recv_multipart())
