# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads point clouds in PLY, ASCII or binary: x y z and the colours of the `vertex` element, in all types that programs
write."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import ply
from ..errors import CaptureError
from ..system.reading import MAX_MODEL_BYTES, read_bytes
from .colmap import PointCloud

HARMONICS = ("f_dc_0", "f_dc_1", "f_dc_2")
COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"),
           ("scalar_red", "scalar_green", "scalar_blue"), HARMONICS)
"""Names of the colours' properties in lower case, in the order in which they are looked for; CloudCompare writes the
fourth."""
HARMONIC_0 = 0.28209479177387814
"""The spherical harmonic of degree 0."""
GREY = 128
"""Colour of the points of a cloud without colours."""
MAX_UNIT_COLOUR = 1.001
"""Largest float colour of a cloud whose colours are 0..1."""


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
    names = [name.lower() for name, _ in layout]
    if len(set(names)) == len(names):
        layout = [(name.lower(), kind) for name, kind in layout]
    if header.format not in ply.BYTE_ORDERS or not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        raise CaptureError(f"{path} is not a PLY file of points with x, y and z.")
    try:
        table = _read_vertices(data, header, layout, number)
    except ValueError as problem:
        raise CaptureError(f"{path} is truncated or damaged; export it again.") from problem
    with np.errstate(over="ignore"):  # infinite values are refused below
        xyz = np.stack([table[name].astype(np.float32) for name in "xyz"], axis=1)
    if not np.isfinite(xyz).all():
        raise CaptureError(f"{path} has points that are not finite numbers; export it again.")
    return PointCloud(xyz, _read_colours(table, dict(layout), number), np.zeros(number, np.float32))


def _read_vertices(data: bytes, header: ply.Header, layout: list[tuple[str, str]], number: int) -> NDArray[Any]:
    """Return the first `number` rows behind the header as a structured array. layout: (name, type) of each property.

    Raises ValueError where they are truncated or damaged.
    """
    if header.format == "ascii":
        lines = data[header.start:].split(b"\n", number)[:number]
        table = np.array([tuple(map(float, line.split())) for line in lines], [(name, "f8") for name, _ in layout])
        if len(table) < number:
            raise ValueError
        return table
    order = ply.BYTE_ORDERS[header.format]
    return ply.read_table(data, np.dtype([(name, order + kind) for name, kind in layout]), number, header.start)


def _read_colours(table: NDArray[Any], kinds: dict[str, str], number: int) -> NDArray[np.uint8]:
    """Return colours (n, 3) of 8 bits; grey where the file has none.

    Whole numbers of 16 bits are divided by 257, of 32 bits by 257 * 65537. Where none is above 255 they are of 8 bits,
    whatever their type. Floats are 0..1, or 0..255 where one is above 1. Gaussian splats have the coefficients f of the
    spherical harmonic of degree 0: colour = 0.5 + HARMONIC_0 f.
    """
    names = next((names for names in COLOURS if set(names) <= set(kinds)), None)
    if names is None or not number:
        return np.full((number, 3), GREY, np.uint8)
    colours = np.nan_to_num(np.stack([table[name].astype(np.float64) for name in names], axis=1))
    largest = float(colours.max(initial=0))
    if names == HARMONICS:
        colours = 255 * (0.5 + HARMONIC_0 * colours)
    elif kinds[names[0]].startswith("f"):
        colours = colours * (255 if largest <= MAX_UNIT_COLOUR else 1)
    elif largest > 255:
        colours = colours / (257 if largest <= 65535 else 257 * 65537)
    return np.asarray(np.clip(colours + 0.5, 0, 255).astype(np.uint8))
