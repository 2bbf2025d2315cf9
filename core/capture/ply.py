# SPDX-License-Identifier: GPL-3.0-or-later
"""Point clouds in PLY, ASCII or binary: the x y z and red green blue of the `vertex` element."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import CaptureError
from .colmap import PointCloud

TYPES = {"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
         "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
         "float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


def read_points(path: Path) -> PointCloud:
    """Read a point cloud; grey where it has no colours. CaptureError where the file is no such thing."""
    try:
        data = path.read_bytes()
    except OSError as problem:
        raise CaptureError(f"{path} cannot be read: {problem.strerror or problem}.") from problem
    end = data.find(b"end_header")
    body = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or not body:
        raise CaptureError(f"{path} is not a PLY file.")
    form, element, number = "", "", 0
    layout: list[tuple[str, str]] = []
    for line in data[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            form = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            if element and element != "vertex" and not layout:
                raise CaptureError(f"{path} does not begin with its vertices; export it again.")
            element = words[1]
            if element == "vertex" and words[2].isdigit():
                number = int(words[2])
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in TYPES:
                raise CaptureError(f"{path} has the vertex property {' '.join(words[1:])!r}, not a plain number.")
            layout.append((words[2], TYPES[words[1]]))
    names = [name for name, _ in layout]
    if form not in ORDERS or not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        raise CaptureError(f"{path} is not a PLY file of points with x, y and z.")
    kind = np.dtype([(name, ORDERS[form] + code) for name, code in layout])
    try:
        if form == "ascii":
            rows = data[body:].split(b"\n", number)[:number]
            table = np.array([tuple(map(float, row.split())) for row in rows],
                             [(name, "f8") for name in names]) if number else np.zeros(0, kind)
            if len(table) < number:
                raise ValueError
        else:
            table = np.frombuffer(data, kind, number, body)
    except ValueError as problem:
        raise CaptureError(f"{path} is truncated or damaged; export it again.") from problem
    xyz = np.stack([table[name].astype(np.float32) for name in "xyz"], axis=1)
    if not np.isfinite(xyz).all():
        raise CaptureError(f"{path} has points that are not finite numbers; export it again.")
    rgb = np.full((number, 3), 128, np.uint8)
    if {"red", "green", "blue"} <= set(names):
        colours = np.stack([table[name].astype(np.float64) for name in ("red", "green", "blue")], axis=1)
        unit = 255.0 if dict(layout)["red"].startswith("f") else 1.0
        rgb = np.clip(colours * unit + 0.5 * (unit > 1), 0, 255).astype(np.uint8)
    return PointCloud(xyz, rgb, np.zeros(number, np.float32))
