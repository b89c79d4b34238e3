"""What goes over the loopback, byte by byte, as an eavesdropper on the same machine or network would see it."""

from __future__ import annotations

import socket
import struct
import threading
from collections import defaultdict
from collections.abc import Set

ETHERNET, ALL_PROTOCOLS, IP_VERSION_4, TCP = 14, 0x0003, b"\x08\x00", 6
BUFFER_BYTES = 64 << 20

Stream = tuple[bytes, int, int]


class Capture:
    """Collects the payload of all TCP segments on the interface ``lo``, per direction of a connection.

    Raises:
        PermissionError: if this process may not listen to raw packets.
    """

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ALL_PROTOCOLS))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        self._socket.bind(("lo", 0))
        self._socket.settimeout(0.1)
        self._segments: dict[Stream, dict[int, bytes]] = defaultdict(dict)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._loop, daemon=True)
        self._thread.start()

    def _loop(self) -> None:
        while not self._stop.is_set():
            try:
                self._take(self._socket.recv(65536 + ETHERNET))
            except TimeoutError:
                continue

    def _take(self, frame: bytes) -> None:
        packet = frame[ETHERNET:]
        if frame[12:ETHERNET] != IP_VERSION_4 or len(packet) < 40 or packet[9] != TCP:
            return
        header = (packet[0] & 15) * 4
        source, target, number = struct.unpack("!HHI", packet[header : header + 8])
        total = int.from_bytes(packet[2:4], "big") or len(packet)
        payload = packet[header + (packet[header + 12] >> 4) * 4 : total]
        if payload:
            self._segments[packet[12:20], source, target][number] = payload

    def close(self) -> None:
        """Stop listening."""
        self._stop.set()
        self._thread.join()
        self._socket.close()

    def bytes_of(self, ports: Set[int]) -> bytes:
        """Everything that was sent from or to these ports, each direction of each connection in one piece."""
        streams = (
            b"".join(segment for _, segment in sorted(segments.items()))
            for (_, source, target), segments in list(self._segments.items())
            if {source, target} & ports
        )
        return b"\0\0".join(streams)
