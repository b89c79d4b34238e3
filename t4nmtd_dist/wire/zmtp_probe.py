"""Reads the ZMTP 3 greeting without libzmq: does ZeroMQ listen, and how is it secured?"""

from __future__ import annotations

import socket
from dataclasses import dataclass

SIGNATURE = b"\xff" + bytes(8) + b"\x7f"
LENGTH = 64
MECHANISM = slice(12, 32)


@dataclass(frozen=True)
class Greeting:
    """A ZeroMQ socket's greeting; ``mechanism`` is ``NULL`` (no keys) or ``CURVE``."""

    mechanism: str


def read_greeting(connection: socket.socket, wait_s: float) -> Greeting | None:
    """Exchange greetings; None if none arrives in time or it is not ZeroMQ's.

    Args:
        connection: a new TCP connection.
        wait_s: timeout in seconds.
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
