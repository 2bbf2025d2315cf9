# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads safetensors files with numpy and json: eight bytes of length, a JSON header, raw little-endian tensors.

The header's size is bounded, and every tensor is checked against the file's length before access; nothing is executed
or unpickled.
"""
from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FlareFileError
from ..system.files import atomic_path
from ..system.reading import parse_json, read_bytes

Arrays = dict[str, NDArray[Any]]

MAX_HEADER_BYTES = 100_000_000  # bytes, the format's own limit
_DTYPES = {"F64": "<f8", "F32": "<f4", "F16": "<f2", "I64": "<i8", "I32": "<i4", "I16": "<i2", "I8": "i1", "U8": "u1",
           "BOOL": "?"}


def read_tensors(path: Path | str) -> tuple[Arrays, dict[str, str]]:
    """Return tensors by name, and the metadata. Raises FlareFileError for a missing or damaged file."""
    path = Path(path)
    if not path.is_file():
        raise FlareFileError(f"{path} is missing; choose a .flare file that a fit has written.")
    try:
        data = read_bytes(path)
        return _parse_tensors(data)
    except OSError as problem:
        raise FlareFileError(f"{path} cannot be read ({problem.strerror or problem}); copy it again, or choose "
                             "another.") from problem
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as problem:
        raise FlareFileError(f"{path} is damaged or not a flare ({problem}); save it again.") from problem


def _parse_tensors(data: bytes) -> tuple[Arrays, dict[str, str]]:
    """Parse a safetensors file to arrays and metadata. Raises ValueError where it is damaged."""
    header_size = int.from_bytes(data[:8], "little")
    if len(data) < 8 or header_size > min(len(data) - 8, MAX_HEADER_BYTES):
        raise ValueError("it ends inside its header")
    header = parse_json(data[8:8 + header_size])
    metadata = header.pop("__metadata__", {}) or {}
    body = memoryview(data)[8 + header_size:]
    arrays: Arrays = {}
    for name, entry in header.items():
        shape = [int(size) for size in entry["shape"]]
        begin, end = (int(offset) for offset in entry["data_offsets"])
        dtype = np.dtype(_DTYPES[entry["dtype"]])
        count = math.prod(shape)
        if min([0, *shape]) < 0 or not 0 <= begin <= end <= len(body) or end - begin != count * dtype.itemsize:
            raise ValueError(f"the tensor {name} does not fit the file")
        # numpy is slow with unaligned numbers, and a header of arbitrary length may leave tensors unaligned.
        arrays[name] = np.require(np.frombuffer(body[begin:end], dtype).reshape(shape), requirements="A")
    return arrays, {str(key): str(value) for key, value in metadata.items()}


def rewrite_metadata(source: Path | str, target: Path | str, metadata: dict[str, str]) -> None:
    """Copy a safetensors file with other metadata and the same tensors, byte for byte. Raises FlareFileError."""
    read_tensors(source)  # raises for an invalid file
    data = read_bytes(source)
    header_size = int.from_bytes(data[:8], "little")
    header = parse_json(data[8:8 + header_size])
    new_header = json.dumps({**header, "__metadata__": metadata}).encode("utf-8")
    new_header += b" " * (-len(new_header) % 8)  # the tensors stay aligned
    with atomic_path(target) as temporary:
        temporary.write_bytes(len(new_header).to_bytes(8, "little") + new_header + data[8 + header_size:])
