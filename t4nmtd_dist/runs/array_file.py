"""Streams safetensors files: ``safetensors.numpy.save`` would copy every array first."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

_KINDS = {
    "bool": "BOOL",
    "int8": "I8",
    "int16": "I16",
    "int32": "I32",
    "int64": "I64",
    "uint8": "U8",
    "uint16": "U16",
    "uint32": "U32",
    "uint64": "U64",
    "float16": "F16",
    "float32": "F32",
    "float64": "F64",
}
_PIECE_BYTES = 1 << 22


def array_file_parts(arrays: Mapping[str, NDArray[Any]]) -> Iterator[bytes | memoryview]:
    """The content of a safetensors file in consecutive pieces.

    Raises:
        TypeError: for a dtype that the format does not have.
    """
    ordered = sorted(arrays.items(), key=lambda item: (-item[1].dtype.itemsize, item[0]))  # keeps data aligned
    header: dict[str, Any] = {}
    offset = 0
    for name, array in ordered:
        end = offset + array.nbytes
        header[name] = {"dtype": _kind(name, array), "shape": array.shape, "data_offsets": [offset, end]}
        offset = end
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    yield len(text).to_bytes(8, "little")
    yield text
    for _, array in ordered:
        yield from _pieces(array)


def _kind(name: str, array: NDArray[Any]) -> str:
    if array.dtype.name not in _KINDS:
        raise TypeError(f"array {name!r} of type {array.dtype} cannot be written to a checkpoint")
    return _KINDS[array.dtype.name]


def _pieces(array: NDArray[Any]) -> Iterator[memoryview]:
    little = array.astype(array.dtype.newbyteorder("<"), copy=False)
    flat = np.ascontiguousarray(little).reshape(-1).view(np.uint8)
    for begin in range(0, len(flat), _PIECE_BYTES):
        yield flat[begin : begin + _PIECE_BYTES].data
