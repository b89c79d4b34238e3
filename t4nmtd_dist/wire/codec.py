"""Framing: a msgpack header, then one raw frame per array, all validated before use."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import msgpack
import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import ProtocolError
from t4nmtd_dist.wire.fields import LONGEST_NAME, OptionalName, explained, shortened
from t4nmtd_dist.wire.messages import KINDS, PROTOCOL_VERSION, Message

Array = NDArray[Any]
Arrays = Mapping[str, Array]

DTYPES = frozenset({"<f4", "<f8", "<i4", "<i8", "|u1", "|i1", "|b1", "<u4", "<u8", "<i2", "<u2"})
MAX_HEADER_BYTES = 4 << 20
MAX_REQUEST_HEADER_BYTES = 128 << 10
MAX_ARRAY_BYTES = 16 << 20
MAX_MESSAGE_BYTES = 32 << 20
MAX_ARRAYS = 1024
MAX_DIMENSIONS = 8
BYTES_PER_ITEM = 32  # minimum header bytes per list item: bounds what msgpack preallocates

ArrayName = Annotated[str, Meta(max_length=LONGEST_NAME + 300)]  # sub-task name plus parameter name
DtypeName = Annotated[str, Meta(max_length=8)]


class Header(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """First frame of every message."""

    v: int
    kind: Annotated[str, Meta(max_length=50)]
    sender: OptionalName
    id: Annotated[int, Meta(ge=0, le=2**63 - 1)]
    body: dict[str, Any]
    arrays: list[tuple[ArrayName, DtypeName, list[int]]]


@dataclass(frozen=True)
class Envelope:
    """A message with its arrays and sender.

    Attributes:
        arrays: by name; after decoding, read-only views of the frames.
        sender: the sender's self-declared name.
        id: message number; a reply repeats its request's.
    """

    message: Message
    arrays: Arrays = field(default_factory=dict)
    sender: str = ""
    id: int = 0


def encode(envelope: Envelope) -> list[bytes]:
    """The frames of a message: header, then arrays (C order, little-endian).

    Raises:
        ProtocolError: if an array's dtype, or the arrays' number or size, is not allowed.
    """
    body = msgspec.to_builtins(envelope.message)
    kind = body.pop("type")
    arrays = {name: np.asarray(array, order="C") for name, array in envelope.arrays.items()}
    _check_sizes(arrays)
    listed = [(name, _dtype_name(name, array), list(array.shape)) for name, array in arrays.items()]
    header = {
        "v": PROTOCOL_VERSION,
        "kind": kind,
        "sender": envelope.sender,
        "id": envelope.id,
        "body": body,
        "arrays": listed,
    }
    return [msgpack.packb(header), *(array.tobytes() for array in arrays.values())]


def _check_sizes(arrays: Arrays) -> None:
    """Reject what would make the receiver drop the connection."""
    for name, array in arrays.items():
        if array.nbytes > MAX_ARRAY_BYTES:
            raise ProtocolError(f"array {name!r} has {array.nbytes} bytes; a message takes {MAX_ARRAY_BYTES} at most")
    size = sum(array.nbytes for array in arrays.values())
    if len(arrays) > MAX_ARRAYS or size > MAX_MESSAGE_BYTES:
        raise ProtocolError(
            f"{len(arrays)} arrays of {size} bytes; a message takes at most {MAX_ARRAYS} arrays of {MAX_MESSAGE_BYTES} "
            "bytes in all: use smaller networks (learner.hidden), or fewer sub-tasks"
        )


def _dtype_name(name: str, array: Array) -> str:
    dtype = array.dtype.str
    if dtype not in DTYPES:
        raise ProtocolError(f"array {name!r} has dtype {array.dtype}; the wire takes {', '.join(sorted(DTYPES))}")
    return dtype


def decode(frames: Sequence[bytes], *, header_bytes: int = MAX_HEADER_BYTES) -> Envelope:
    """Decode and validate one message, in time proportional to its size.

    Args:
        frames: header and arrays.
        header_bytes: the largest header to accept.

    Raises:
        ProtocolError: with the violation.
    """
    if not frames:
        raise ProtocolError("expected a header frame, got an empty message")
    header = _header(frames[0], min(header_bytes, MAX_HEADER_BYTES))
    kind = KINDS.get(header.kind)
    if kind is None:
        raise ProtocolError(f"unknown message kind {header.kind!r}; known: {', '.join(KINDS)}")
    try:
        message = msgspec.convert({**header.body, "type": header.kind}, kind)
    except (msgspec.ValidationError, RecursionError) as error:
        raise ProtocolError(f"message {header.kind!r}: {explained(error)}") from None
    return Envelope(message, _arrays(header, frames[1:]), header.sender, header.id)


def _header(frame: bytes, most: int) -> Header:
    if len(frame) > most:
        raise ProtocolError(f"header of {len(frame)} bytes; at most {most} are allowed")
    items = most // BYTES_PER_ITEM
    try:
        raw = msgpack.unpackb(frame, max_array_len=items, max_map_len=items)
    except Exception as error:  # msgpack raises many exception types on malformed input
        raise ProtocolError(shortened(f"the header is not msgpack: {error}")) from None
    version = raw.get("v") if isinstance(raw, dict) else None
    if version != PROTOCOL_VERSION:
        raise ProtocolError(shortened(f"protocol version {version!r}; this program speaks {PROTOCOL_VERSION}"))
    try:
        return msgspec.convert(raw, Header)
    except (msgspec.ValidationError, RecursionError) as error:
        raise ProtocolError(f"malformed header: {explained(error)}") from None


def _arrays(header: Header, frames: Sequence[bytes]) -> dict[str, Array]:
    if len(frames) > MAX_ARRAYS:
        raise ProtocolError(f"{header.kind!r} carries {len(frames)} arrays; at most {MAX_ARRAYS} are allowed")
    if len(header.arrays) != len(frames):
        raise ProtocolError(f"{header.kind!r} announces {len(header.arrays)} arrays and carries {len(frames)}")
    if sum(len(frame) for frame in frames) > MAX_MESSAGE_BYTES:
        raise ProtocolError(f"the arrays of a message have more than {MAX_MESSAGE_BYTES} bytes")
    if len({name for name, _, _ in header.arrays}) != len(frames):
        raise ProtocolError(f"{header.kind!r} names an array twice")
    return {
        name: _array(name, dtype, shape, frame)
        for (name, dtype, shape), frame in zip(header.arrays, frames, strict=True)
    }


def _array(name: str, dtype: str, shape: list[int], frame: bytes) -> Array:
    if dtype not in DTYPES:
        raise ProtocolError(f"array {name!r}: dtype {dtype!r} is not allowed")
    if len(shape) > MAX_DIMENSIONS:
        raise ProtocolError(f"array {name!r}: a shape of {len(shape)} dimensions; at most {MAX_DIMENSIONS} are allowed")
    if not all(0 <= side <= MAX_ARRAY_BYTES for side in shape) or not _sides_fit(shape):
        raise ProtocolError(f"array {name!r}: shape {shape} is not allowed")
    expected = math.prod(shape) * np.dtype(dtype).itemsize
    if expected > MAX_ARRAY_BYTES or expected != len(frame):
        raise ProtocolError(f"array {name!r}: {len(frame)} bytes for shape {shape} {dtype}, expected {expected}")
    return np.frombuffer(frame, dtype).reshape(shape)


def _sides_fit(shape: list[int]) -> bool:
    """Whether numpy accepts a shape: its size check ignores empty sides."""
    return math.prod(max(side, 1) for side in shape) <= MAX_ARRAY_BYTES


def with_prefix(prefix: str, arrays: Arrays) -> dict[str, Array]:
    """The arrays with ``prefix`` added to their names."""
    return {prefix + name: array for name, array in arrays.items()}


def without_prefix(prefix: str, arrays: Arrays) -> dict[str, Array]:
    """The arrays whose names begin with ``prefix``, without it."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
