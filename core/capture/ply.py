# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads point clouds in PLY, ASCII or binary: x y z and red green blue of the `vertex` element."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from .. import ply
from ..errors import CaptureError
from ..system.reading import MAX_MODEL_BYTES, read_bytes
from .colmap import PointCloud


def read_points(path: Path) -> PointCloud:
    """Read a point cloud; grey where it has no colours. Raises CaptureError where the file is no point cloud."""
    try:
        data = read_bytes(path, MAX_MODEL_BYTES)
    except OSError as problem:
        raise CaptureError(f"{path} cannot be read: {problem.strerror or problem}.") from problem
    header = ply.read_header(data)
    if header is None:
        raise CaptureError(f"{path} is not a PLY file.")
    vertices = header.elements[0] if header.elements else ply.Element("vertex", 0, [])
    if vertices.name != "vertex" or vertices.rows < 0:
        raise CaptureError(f"{path} does not begin with its vertices; export it again.")
    try:
        layout, number = vertices.layout(), vertices.rows
    except ValueError as problem:
        raise CaptureError(f"{path} has the vertex property {problem}, not a plain number.") from problem
    names = [name for name, _ in layout]
    if header.format not in ply.BYTE_ORDERS or not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        raise CaptureError(f"{path} is not a PLY file of points with x, y and z.")
    try:
        if header.format == "ascii":
            lines = data[header.start:].split(b"\n", number)[:number]
            table = np.array([tuple(map(float, line.split())) for line in lines], [(name, "f8") for name in names])
            if len(table) < number:
                raise ValueError
        else:
            table = ply.read_table(data, vertices.row(ply.BYTE_ORDERS[header.format]), number, header.start)
    except ValueError as problem:
        raise CaptureError(f"{path} is truncated or damaged; export it again.") from problem
    with np.errstate(over="ignore"):  # told below
        xyz = np.stack([table[name].astype(np.float32) for name in "xyz"], axis=1)
    if not np.isfinite(xyz).all():
        raise CaptureError(f"{path} has points that are not finite numbers; export it again.")
    rgb = np.full((number, 3), 128, np.uint8)
    if {"red", "green", "blue"} <= set(names):
        colours = np.stack([table[name].astype(np.float64) for name in ("red", "green", "blue")], axis=1)
        unit = 255.0 if dict(layout)["red"].startswith("f") else 1.0
        rgb = np.clip(np.nan_to_num(colours) * unit + 0.5 * (unit > 1), 0, 255).astype(np.uint8)
    return PointCloud(xyz, rgb, np.zeros(number, np.float32))
