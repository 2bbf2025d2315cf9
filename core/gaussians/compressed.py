# SPDX-License-Identifier: GPL-3.0-or-later
"""Reader for PlayCanvas's compressed PLY, which SuperSplat and gsplat's exporter write (usually .compressed.ply).

Called by `ply.read_ply`. Gaussians are quantised in chunks of 256. The file's elements:

    chunk   float32: minimum and maximum of position, log scale and colour
    vertex  four uint32: packed_position and packed_scale, 11, 10, 11 bits within the chunk's range; packed_rotation,
            2 bits for the index of the largest component and 10 for each of the others; packed_color, four bytes, of
            which the last is the opacity
    sh      a byte for each f_rest, -4..4
"""
from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .. import ply
from ..errors import FlareFileError
from ..system.reading import open_regular, read_bytes
from .scene import COEFFICIENTS, SceneGaussians
from .spherical_harmonics import dc_from_colour

CHUNK = 256
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_MAX_HEADER_BYTES = 1 << 16
_STORED_COMPONENTS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # of w x y z; row i if i is the largest

Floats = NDArray[np.float32]


def is_compressed(path: Path) -> bool:
    """Return whether a file begins with the header of a compressed PLY. Raises OSError for an unreadable file."""
    with open_regular(path) as file:
        head = file.read(_MAX_HEADER_BYTES).split(b"end_header")[0]
    return head.startswith(b"ply") and b" packed_position\n" in head.replace(b"\r", b"")


def read_compressed(path: Path) -> SceneGaussians:
    """Read a compressed PLY, in the layout of the module head. Raises FlareFileError for a damaged file."""
    try:
        elements = _read_elements(read_bytes(path))
        chunks, vertices = elements["chunk"], elements["vertex"]
        count = len(vertices)
        if len(chunks) * CHUNK < count:
            raise ValueError(f"{len(chunks)} chunks for {count} Gaussians")
        chunk_of = np.arange(count) // CHUNK
        position, rotation, scale, colour = (vertices[name].astype(np.uint32) for name in PACKED)
        means = _dequantise(chunks, chunk_of, _unpack(position, 11, 10, 11), "{}_x", "{}_y", "{}_z")
        log_scales = _dequantise(chunks, chunk_of, _unpack(scale, 11, 10, 11), "{}_scale_x", "{}_scale_y", "{}_scale_z")
        rgba = _unpack(colour, 8, 8, 8, 8)
        rgb = rgba[:, :3]  # older files have no range of colours: 0..1
        if "min_r" in (chunks.dtype.names or ()):
            rgb = _dequantise(chunks, chunk_of, rgb, "{}_r", "{}_g", "{}_b")
        opacity = np.clip(rgba[:, 3], 0.5 / 255, 254.5 / 255)  # 0 and 1 have no finite logit
        sh = torch.zeros(count, COEFFICIENTS, 3)
        sh[:, 0] = dc_from_colour(torch.from_numpy(rgb))
        if "sh" in elements and (names := elements["sh"].dtype.names):
            rest = _dequantise_harmonics(np.stack([elements["sh"][f"f_rest_{i}"] for i in range(len(names))], -1))
            per_channel = len(names) // 3
            sh[:, 1:1 + per_channel] = torch.from_numpy(rest).reshape(count, 3, per_channel).transpose(1, 2)
        logits = np.log(opacity / (1 - opacity))
        scene = SceneGaussians(torch.from_numpy(means), torch.from_numpy(log_scales),
                               torch.from_numpy(_unpack_quaternions(rotation)), torch.from_numpy(logits), sh)
    except (KeyError, ValueError, RuntimeError) as problem:
        raise FlareFileError(f"{path} is a damaged compressed PLY ({problem}); export it again.") from problem
    if not all(parameter.isfinite().all() for parameter in scene.parameters()):
        raise FlareFileError(f"{path} holds numbers that are not finite; export it again.")
    return scene


def _read_elements(data: bytes) -> dict[str, NDArray[Any]]:
    """Return the elements by name, as structured arrays. Raises ValueError for a damaged header."""
    header = ply.read_header(data)
    if header is None:
        raise ValueError("its header has no end")
    if header.format != "binary_little_endian":
        raise ValueError(f"its format is {header.format}")
    elements, offset = {}, header.start
    for element in header.elements:
        if element.rows < 0:
            raise ValueError(f"the number of rows of {element.name} is none")
        elements[element.name] = ply.read_table(data, element.row("<"), element.rows, offset)
        offset += elements[element.name].nbytes
    return elements


def _unpack(packed: NDArray[np.uint32], *bits: int) -> Floats:
    """Unpack bit fields of these widths, highest first, to 0..1: (n,) to (n, fields)."""
    remaining, fields = 32, []
    for width in bits:
        remaining -= width
        max_code = (1 << width) - 1
        codes = (packed >> np.uint32(remaining)) & np.uint32(max_code)
        fields.append(codes.astype(np.float32) / np.float32(max_code))
    return np.stack(fields, -1)


def _dequantise(chunks: NDArray[Any], chunk_of: NDArray[np.int64], fraction: Floats, *names: str) -> Floats:
    """Map fractions 0..1 (n, 3) linearly to the range min..max of each Gaussian's chunk.

    chunk_of (n,): index of that chunk; names: three columns of `chunks`, with {} in place of "min" and "max"."""
    low, high = (np.stack([chunks[name.format(end)] for name in names], -1)[chunk_of] for end in ("min", "max"))
    return np.asarray(low + fraction * (high - low), np.float32)


def _unpack_quaternions(packed: NDArray[np.uint32]) -> Floats:
    """Unpack (n,) to unit quaternions (n, 4), w x y z.

    The top 2 bits are the index of the largest component, which follows from the length 1; the other three lie within
    ±1 / sqrt(2) and have 10 bits each."""
    largest = (packed >> np.uint32(30)).astype(np.int64)
    stored = (_unpack(packed & np.uint32((1 << 30) - 1), 2, 10, 10, 10)[:, 1:] - np.float32(0.5)) * np.float32(
        math.sqrt(2))
    rows = np.arange(len(packed))
    quaternions = np.zeros((len(packed), 4), np.float32)
    quaternions[rows[:, None], _STORED_COMPONENTS[largest]] = stored
    quaternions[rows, largest] = np.sqrt(np.maximum(1 - (stored**2).sum(-1), 0))
    return quaternions


def _dequantise_harmonics(stored: NDArray[np.uint8]) -> Floats:
    """Map bytes to -4..4: 0 and 255 to the ends, every other byte to the middle of its step."""
    fraction = (stored.astype(np.float32) + 0.5) / 256
    fraction = np.where(stored == 0, 0, np.where(stored == 255, 1, fraction))
    return np.asarray((fraction - 0.5) * 8, np.float32)
