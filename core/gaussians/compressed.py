# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes in PlayCanvas's compressed PLY, which SuperSplat and gsplat's exporter write (usually .compressed.ply).

Gaussians are quantised in chunks of 256. Elements `chunk` (float32: min and max of position, log scale and
colour), `vertex` (four uint32: packed_position and packed_scale as 11, 10, 11 bits within the chunk's range,
packed_rotation as the number of the largest component and the three others in 10 bits each, packed_color as
four bytes, the last the opacity) and `sh` (a byte for each f_rest, -4..4).
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
from .scene import COEFFICIENTS, SceneGaussians
from .spherical_harmonics import dc_from_colour

CHUNK = 256
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_HEAD = 1 << 16
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # the components that are stored, w x y z

Floats = NDArray[np.float32]


def is_compressed(path: Path) -> bool:
    """Whether the file's header says that it is such a file. OSError where it cannot be read."""
    with open(path, "rb") as file:
        head = file.read(_HEAD).split(b"end_header")[0]
    return head.startswith(b"ply") and b" packed_position\n" in head.replace(b"\r", b"")


def read_compressed(path: Path) -> SceneGaussians:
    """Read such a file. FlareFileError where it is damaged."""
    try:
        tables = _tables(path.read_bytes())
        chunks, vertices = tables["chunk"], tables["vertex"]
        n = len(vertices)
        if len(chunks) * CHUNK < n:
            raise ValueError(f"{len(chunks)} chunks for {n} Gaussians")
        of = np.arange(n) // CHUNK
        position, rotation, scale, colour = (vertices[name].astype(np.uint32) for name in PACKED)
        means = _within(chunks, of, _unpack(position, 11, 10, 11), "{}_x", "{}_y", "{}_z")
        log_scales = _within(chunks, of, _unpack(scale, 11, 10, 11), "{}_scale_x", "{}_scale_y", "{}_scale_z")
        rgba = _unpack(colour, 8, 8, 8, 8)
        rgb = rgba[:, :3]
        if "min_r" in (chunks.dtype.names or ()):
            rgb = _within(chunks, of, rgb, "{}_r", "{}_g", "{}_b")
        opacity = np.clip(rgba[:, 3], 0.5 / 255, 254.5 / 255)  # the ends have no finite logit
        sh = torch.zeros(n, COEFFICIENTS, 3)
        sh[:, 0] = dc_from_colour(torch.from_numpy(rgb))
        if "sh" in tables and (names := tables["sh"].dtype.names):
            rest = _harmonics(np.stack([tables["sh"][f"f_rest_{i}"] for i in range(len(names))], -1))
            per = len(names) // 3
            sh[:, 1:1 + per] = torch.from_numpy(rest).reshape(n, 3, per).transpose(1, 2)
        logits = np.log(opacity / (1 - opacity))
        scene = SceneGaussians(torch.from_numpy(means), torch.from_numpy(log_scales),
                               torch.from_numpy(_quaternions(rotation)), torch.from_numpy(logits), sh)
    except (KeyError, ValueError, RuntimeError) as problem:
        raise FlareFileError(f"{path} is a damaged compressed PLY ({problem}); export it again.") from problem
    if not all(parameter.isfinite().all() for parameter in scene.parameters()):
        raise FlareFileError(f"{path} holds numbers that are not finite; export it again.")
    return scene


def _tables(data: bytes) -> dict[str, NDArray[Any]]:
    """The elements by name, as structured arrays."""
    header = ply.read_header(data)
    if header is None:
        raise ValueError("its header has no end")
    if header.form != "binary_little_endian":
        raise ValueError(f"its format is {header.form}")
    tables, at = {}, header.start
    for element in header.elements:
        if element.rows < 0:
            raise ValueError(f"the number of rows of {element.name} is none")
        tables[element.name] = ply.table(data, element.row("<"), element.rows, at)
        at += tables[element.name].nbytes
    return tables


def _unpack(packed: NDArray[np.uint32], *bits: int) -> Floats:
    """Fields of these widths, the first the highest, to 0..1: (n,) to (n, fields)."""
    left, fields = 32, []
    for width in bits:
        left -= width
        top = (1 << width) - 1
        fields.append(((packed >> np.uint32(left)) & np.uint32(top)).astype(np.float32) / np.float32(top))
    return np.stack(fields, -1)


def _within(chunks: NDArray[Any], of: NDArray[np.int64], share: Floats, *names: str) -> Floats:
    """Shares 0..1 (n, 3) of each chunk's range."""
    low, high = (np.stack([chunks[name.format(end)] for name in names], -1)[of] for end in ("min", "max"))
    return np.asarray(low + share * (high - low), np.float32)


def _quaternions(packed: NDArray[np.uint32]) -> Floats:
    """(n,) to unit quaternions (n, 4), w x y z."""
    largest = (packed >> np.uint32(30)).astype(np.int64)
    stored = (_unpack(packed & np.uint32((1 << 30) - 1), 2, 10, 10, 10)[:, 1:] - np.float32(0.5)) * np.float32(
        math.sqrt(2))
    rows = np.arange(len(packed))
    quaternions = np.zeros((len(packed), 4), np.float32)
    quaternions[rows[:, None], _OTHERS[largest]] = stored
    quaternions[rows, largest] = np.sqrt(np.maximum(1 - (stored**2).sum(-1), 0))
    return quaternions


def _harmonics(stored: NDArray[np.uint8]) -> Floats:
    """Bytes to -4..4, the middle of each step, the ends exactly."""
    share = (stored.astype(np.float32) + 0.5) / 256
    share = np.where(stored == 0, 0, np.where(stored == 255, 1, share))
    return np.asarray((share - 0.5) * 8, np.float32)
