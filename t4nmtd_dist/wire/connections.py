"""Inspects and ends TCP connections owned by libzmq."""

from __future__ import annotations

import os
import socket as sockets
import struct
import sys
from contextlib import suppress
from dataclasses import dataclass

import zmq

BYTES_RECEIVED = 128  # offset of tcpi_bytes_received in Linux's struct tcp_info


@dataclass(frozen=True)
class Connection:
    """A connection's descriptor, and the inode that detects a reused descriptor."""

    descriptor: int
    inode: int

    def received(self) -> int | None:
        """Bytes received so far; None if unknown or the connection has ended."""
        if sys.platform != "linux":
            return None
        with suppress(OSError):
            borrowed = sockets.socket(sockets.AF_INET, sockets.SOCK_STREAM, 0, fileno=self.descriptor)
            try:
                info = borrowed.getsockopt(sockets.IPPROTO_TCP, sockets.TCP_INFO, BYTES_RECEIVED + 8)
            finally:
                borrowed.detach()
            if len(info) == BYTES_RECEIVED + 8:
                return int(struct.unpack_from("=Q", info, BYTES_RECEIVED)[0])
        return None

    def end(self) -> bool:
        """Shut it down; False if it had already ended."""
        with suppress(OSError), sockets.socket(fileno=os.dup(self.descriptor)) as duplicate:
            if os.fstat(duplicate.fileno()).st_ino == self.inode:
                duplicate.shutdown(sockets.SHUT_RDWR)
                return True
        return False


def connection(descriptor: int) -> Connection | None:
    """The connection of a descriptor; None if it has ended."""
    with suppress(OSError):
        return Connection(descriptor, os.fstat(descriptor).st_ino)
    return None


def connection_of(frame: zmq.Frame) -> Connection | None:
    """The connection that a frame came over; None if it has ended."""
    with suppress(zmq.ZMQError, TypeError, ValueError):
        return connection(int(frame.get(zmq.SRCFD)))
    return None
