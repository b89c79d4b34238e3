"""What somebody who means harm sends to the sockets of a training, over connections of its own to loopback."""

from __future__ import annotations

import os
import random
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import msgpack
import numpy as np
import psutil

from t4nmtd_dist.wire.codec import Envelope, encode
from t4nmtd_dist.wire.messages import (
    PROTOCOL_VERSION,
    Claim,
    EvaluationPoll,
    EvaluationReport,
    ExperienceRequest,
    LearnerStats,
    Release,
    StatusRequest,
    Sync,
    ValueRequest,
    WeightsRequest,
)

GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
MORE, LONG, COMMAND = 1, 2, 4


def frame(content: bytes, flags: int = 0) -> bytes:
    """A frame as ZMTP puts it on the wire."""
    if len(content) > 255:
        return struct.pack(">BQ", flags | LONG, len(content)) + content
    return struct.pack(">BB", flags, len(content)) + content


def multipart(frames: list[bytes]) -> bytes:
    """A whole message on the wire."""
    return b"".join(frame(content, MORE) for content in frames[:-1]) + frame(frames[-1])


def ready(kind: bytes) -> bytes:
    """The command that ends ZMTP's handshake without keys."""
    properties = b"".join(
        bytes([len(name)]) + name + struct.pack(">I", len(value)) + value
        for name, value in ((b"Socket-Type", kind), (b"Identity", b""))
    )
    return frame(b"\x05READY" + properties, COMMAND)


@contextmanager
def raw_connection(endpoint: str, kind: bytes = b"DEALER") -> Iterator[socket.socket]:
    """A connection that has shaken hands, and sends whatever bytes one likes."""
    host, port = endpoint.removeprefix("tcp://").rsplit(":", 1)
    with socket.create_connection((host, int(port)), timeout=10.0) as connection:
        connection.sendall(GREETING)
        greeted = b""
        while len(greeted) < 64:
            greeted += connection.recv(64 - len(greeted))
        connection.sendall(ready(kind))
        connection.recv(4096)
        yield connection


def pour(connection: socket.socket, pieces: Iterator[bytes], seconds: float = 20.0) -> int:
    """Send pieces until the other side ends the connection or stops reading; bytes sent."""
    sent, deadline = 0, time.monotonic() + seconds
    connection.settimeout(2.0)
    with suppress(OSError):
        for piece in pieces:
            if time.monotonic() > deadline:
                break
            connection.sendall(piece)
            sent += len(piece)
    return sent


def endless_multipart(endpoint: str, total: int = 1 << 30) -> int:
    """One message of many frames of 1 MiB that never ends; bytes sent."""
    piece = frame(bytes(1 << 20), MORE)
    with raw_connection(endpoint) as connection:
        return pour(connection, (piece for _ in range(total >> 20)))


def empty_frames(endpoint: str, total: int = 64 << 20) -> int:
    """One message of empty frames, each of which costs the receiver far more than its two bytes; bytes sent."""
    piece = frame(b"", MORE) * 10_000
    with raw_connection(endpoint) as connection:
        return pour(connection, (piece for _ in range(total // len(piece))))


def subscriptions(endpoint: str, count: int = 40_000) -> int:
    """Subscriptions to long topics, all different; bytes sent."""
    with raw_connection(endpoint, b"SUB") as connection:
        return pour(connection, (frame(b"\x01" + os.urandom(1000)) for _ in range(count)))


def unread_answers(endpoint: str, count: int = 5_000) -> int:
    """Questions whose answers are never read; bytes sent."""
    question = multipart(encode(Envelope(StatusRequest())))
    with raw_connection(endpoint) as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        return pour(connection, (question for _ in range(count)), 5.0)


def many_connections(endpoint: str, count: int = 400, hold_s: float = 1.0) -> int:
    """Connections that say nothing; how many were open at a time."""
    host, port = endpoint.removeprefix("tcp://").rsplit(":", 1)
    held: list[socket.socket] = []
    with suppress(OSError):
        held.extend(socket.create_connection((host, int(port)), timeout=2.0) for _ in range(count))
    time.sleep(hold_s)
    for connection in held:
        connection.close()
    return len(held)


def real_messages() -> list[list[bytes]]:
    """Frames of well-formed messages, dangerous in what they say."""
    stats = LearnerStats(phase="training", interactions=10**9, attempts=5)
    sync = Sync(pid="p1", epoch=1, sequence=1, version=9, start_cursor=0, stats=stats)
    weights = {f"weights.actor.{i}.weight": np.full((64, 64), np.nan, np.float32) for i in range(3)}
    report = EvaluationReport(
        epoch=1, job=1, success_rate=1.0, mean_length=1.0, std_length=0.0, mean_return=1.0, episodes=1, dfa_path=[0]
    )
    rows = {"observation": np.full((8, 4), np.inf, np.float32), "q": np.full(8, 10**6, np.int32)}
    told = [
        Envelope(Claim(role="learner", instance="stranger", pid="p9", critic_endpoint="tcp://127.0.0.1:1")),
        Envelope(sync, weights),
        Envelope(sync, {"progress.q": np.full((5, 3), -9, np.int32), "progress.reward": np.full(5, np.nan)}),
        Envelope(Release(pid="p1", epoch=1)),
        Envelope(EvaluationPoll(epoch=1)),
        Envelope(report),
        Envelope(StatusRequest()),
        Envelope(ValueRequest(pid="p1"), rows),
        Envelope(WeightsRequest(pid="p1", newer_than=-1)),
        Envelope(ExperienceRequest(pid="p1", step=2**53)),
    ]
    return [encode(envelope) for envelope in told]


def header(**fields: object) -> bytes:
    """A header of a ``release`` but for some fields."""
    plain = {"v": PROTOCOL_VERSION, "kind": "release", "sender": "", "id": 0, "body": {"pid": "p", "epoch": 1}}
    packed: bytes = msgpack.packb({**plain, "arrays": [], **fields})
    return packed


def overflowing() -> list[list[bytes]]:
    """Messages whose numbers, names or shapes are out of all bounds."""
    stats = {"phase": "training", "attempts": 2**64 - 1, "interactions": 2**64 - 1, "processor_s": float("nan")}
    body = {"pid": "p1", "epoch": 1, "sequence": 2**64 - 1, "version": 2**63, "start_cursor": 0, "stats": stats}
    return [
        [header(kind="sync", body=body)],
        [header(kind="claim", body={"role": "learner", "instance": "\x1b[2J\n\u202e"})],
        [header(arrays=[("a", "<f4", [2**63 - 1] * 9000)]), b"1234"],
        [header(arrays=[("a", "<f4", [0, 2**63 - 1])]), b""],
        [header(arrays=[["a", "|O", [1]]]), b"12345678"],
        [header(v=10**18)],
        [b"\x91" * 2000 + b"\xc0"],
        [b"\xdd\xff\xff\xff\xff" * 50],
        [header(body={str(number): number for number in range(500)})],
        [],
    ]


def mutated(frames: list[bytes], rng: random.Random) -> list[bytes]:
    """A message with a few bytes changed, a frame dropped, repeated or cut short."""
    changed = [bytearray(each) for each in frames]
    for _ in range(rng.randint(1, 4)):
        target = rng.choice(changed)
        if target:
            target[rng.randrange(len(target))] = rng.randrange(256)
    action = rng.randrange(5)
    if action == 0:
        changed.append(bytearray(rng.randbytes(rng.randrange(50))))
    elif action == 1 and len(changed) > 1:
        changed.pop()
    elif action == 2:
        changed[0] = changed[0][: rng.randrange(len(changed[0]) + 1)]
    return [bytes(each) for each in changed]


def malformed(rng: random.Random) -> Iterator[list[bytes]]:
    """Malformed messages without end."""
    real, wild = real_messages(), overflowing()
    while True:
        draw = rng.random()
        if draw < 0.6:
            yield mutated(rng.choice(real), rng)
        elif draw < 0.8:
            yield [rng.randbytes(rng.randrange(200)) for _ in range(rng.randint(1, 4))]
        else:
            yield rng.choice(wild) or [b""]


def malformed_messages(endpoint: str, count: int, seed: int, pause_s: float = 0.0) -> int:
    """Send ``count`` malformed messages, over another connection whenever one is ended; how many were sent."""
    rng, sent = random.Random(seed), 0
    messages = malformed(rng)
    while sent < count:
        with suppress(OSError), raw_connection(endpoint) as connection:
            connection.settimeout(5.0)
            reader = threading.Thread(target=_read_all, args=(connection,), daemon=True)
            reader.start()
            while sent < count:
                batch = [multipart(next(messages)) for _ in range(min(50, count - sent))]
                connection.sendall(b"".join(batch))
                sent += len(batch)
                time.sleep(pause_s)
    return sent


def _read_all(connection: socket.socket) -> None:
    with suppress(OSError):
        while connection.recv(1 << 16):
            pass


class MemoryWatch:
    """Resident memory of processes while something happens, in bytes by process number.

    Attributes:
        before: at the beginning.
        peak: the most since then.
    """

    def __init__(self, numbers: list[int]) -> None:
        self._processes = {number: psutil.Process(number) for number in numbers}
        self.before = self.now()
        self.peak = dict(self.before)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def now(self) -> dict[int, int]:
        """As it is now; of processes that have ended nothing."""
        found = {}
        for number, process in self._processes.items():
            with suppress(psutil.NoSuchProcess):
                found[number] = int(process.memory_info().rss)
        return found

    def _watch(self) -> None:
        while not self._stop.wait(0.02):
            for number, memory in self.now().items():
                self.peak[number] = max(self.peak[number], memory)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()


def together(*attacks: Callable[[], object]) -> None:
    """Carry several attacks out at the same time."""
    threads = [threading.Thread(target=attack, daemon=True) for attack in attacks]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
