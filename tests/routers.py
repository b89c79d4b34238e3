"""Receiving at a bound ROUTER, for tests that stand in for a coordinator or a peer."""

from __future__ import annotations

import zmq

from t4nmtd_dist.core.errors import ProtocolError
from t4nmtd_dist.wire.codec import Envelope, decode
from t4nmtd_dist.wire.zmq_types import Socket


def receive_from(socket: Socket) -> tuple[bytes, Envelope | ProtocolError] | None:
    """The next message waiting at a ROUTER with its sender, or why it cannot be read; None if there is none."""
    try:
        peer, *frames = socket.recv_multipart(flags=zmq.NOBLOCK)
    except zmq.Again:
        return None
    try:
        return peer, decode(frames)
    except ProtocolError as error:
        return peer, error
