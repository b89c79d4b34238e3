"""The first bytes of ZMTP 3, read without libzmq: whether ZeroMQ listens at a port at all, and how it is secured."""

from __future__ import annotations

import socket
from dataclasses import dataclass

SIGNATURE = b"\xff" + bytes(8) + b"\x7f"
LENGTH = 64
MECHANISM = slice(12, 32)


@dataclass(frozen=True)
class Greeting:
    """What a ZeroMQ socket says first; ``mechanism`` is ``NULL`` (no keys) or ``CURVE``."""

    mechanism: str


def read_greeting(connection: socket.socket, wait_s: float) -> Greeting | None:
    """Greet, and read the other side's greeting; None if there is none within ``wait_s``, or it is not ZeroMQ's.

    Args:
        connection: a fresh TCP connection.
        wait_s: seconds to wait.
    """
    connection.settimeout(wait_s)
    received = b""
    try:
        connection.sendall(SIGNATURE + b"\x03\x00")
        while len(received) < LENGTH:
            more = connection.recv(LENGTH - len(received))
            if not more:
                break
            received += more
            if received[:1] != SIGNATURE[:1]:
                return None
    except OSError:
        return None
    if len(received) < MECHANISM.stop or received[9:10] != SIGNATURE[-1:]:
        return None
    return Greeting(received[MECHANISM].rstrip(b"\0").decode("ascii", errors="replace"))
