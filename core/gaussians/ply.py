# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads and writes scenes as PLY files, in the layout of the 3DGS authors, which viewers and editors read.

One binary element `vertex` of float32: x y z, nx ny nz (unused), f_dc_0..2 (degree 0, by channel),
f_rest_0..44 (the 15 others, all of one channel before the next), opacity (logit), scale_0..2 (log),
rot_0..3 (w x y z). Fewer f_rest (0, 9, 24) mean a lower degree. `compressed` reads compressed files.
"""
from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from .. import ply
from ..conventions.pixel_grid import PixelGrid
from ..errors import FlareFileError
from ..system.files import atomic_path
from ..system.reading import open_regular
from .compressed import is_compressed, read_compressed
from .far_sphere import FarSphere
from .rendering import NEAR
from .scene import COEFFICIENTS, SceneGaussians

MODE_COMMENT = "SplatRenderMode:"
"""Header comment of scenes that were trained with a mip filter, as Brush writes it, with the value "mip"."""
MAX_HEADER_BYTES = 1 << 16
NEAR_COMMENT, WHITE_COMMENT, FOCAL_COMMENT, FAR_COMMENT = "near", "white", "focal_lengths", "far_sphere"
"""Header comments of this package: the scene's `near` and `display_white`, a number each, unless they have their
defaults, the two focal lengths of its `pixel_grid`, if it has one, and centre and radius of its far sphere, likewise.
"""
MAX_WHITE = 107.0
"""Largest display white in a file: somewhat above the display value of the largest half float."""
ORDERS = {form: order for form, order in ply.BYTE_ORDERS.items() if form != "ascii"}
POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
DC = tuple(f"f_dc_{i}" for i in range(3))
SCALE = tuple(f"scale_{i}" for i in range(3))
ROTATION = tuple(f"rot_{i}" for i in range(4))
LEGAL_INFINITIES = {"opacity": (-20.0, 20.0), **dict.fromkeys(SCALE, (-30.0, np.inf))}
"""Numbers that stand for minus and plus infinity: opacities of 0 and 1 have infinite logits, and a flat Gaussian has a
scale of which the logarithm is minus infinity."""


def _rest_names(number: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(number))


def write_ply(path: Path | str, scene: SceneGaussians, *, extra: Mapping[str, NDArray[np.float32]] | None = None,
              comments: Sequence[str] = ()) -> None:
    """Write a scene atomically as a binary PLY of 3DGS; `read_ply` restores every parameter exactly.

    extra: further properties by name, (n,) each, which other readers ignore. comments: ASCII lines for the header,
    before those that store the scene's near plane, white, pixel grid, far sphere and mip filter.
    """
    extra = extra or {}
    rest_names = _rest_names(3 * (COEFFICIENTS - 1))
    names = POSITION + NORMAL + DC + rest_names + ("opacity",) + SCALE + ROTATION + tuple(extra)
    n = len(scene)
    means, log_scales, quaternions, opacities, sh = (
        parameter.detach().cpu().numpy().astype("<f4")
        for parameter in (
            scene.means, scene.log_scales, scene.quaternions, scene.opacity_logits, scene.sh
        )
    )  # fmt: skip
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(n, 3 * (COEFFICIENTS - 1))
    table = np.concatenate(
        [means, np.zeros((n, 3), "<f4"), sh[:, 0], rest, opacities[:, None], log_scales, quaternions,
         *(np.asarray(column, "<f4")[:, None] for column in extra.values())], 1
    )
    scene_comments = ((NEAR_COMMENT, scene.near, NEAR), (WHITE_COMMENT, scene.display_white, 1.0))
    comments = [*comments, *(f"{keyword} {number:.9g}" for keyword, number, default in scene_comments
                             if number != default)]
    if scene.pixel_grid is not None:
        grid = scene.pixel_grid
        comments.append(f"{FOCAL_COMMENT} {grid.min_focal_length:.9g} {grid.max_focal_length:.9g}")
    if scene.far is not None:
        comments.append(" ".join([FAR_COMMENT, *(f"{number:.9g}" for number in (*scene.far.centre, scene.far.radius))]))
    if scene.antialiased:
        comments.append(f"{MODE_COMMENT} mip")
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments),
             f"element vertex {n}"]
    lines += [f"property float {name}" for name in names] + ["end_header"]
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(("\n".join(lines) + "\n").encode("ascii", "replace"))
        file.write(np.ascontiguousarray(table, "<f4").tobytes())


def read_ply(path: Path | str) -> SceneGaussians:
    """Read a scene from a PLY, plain or compressed; properties may have any order, and unknown ones are ignored.

    Raises FlareFileError for a file that is no PLY of Gaussians, is cut short, or holds numbers that are not finite
    other than the LEGAL_INFINITIES.
    """
    path = Path(path)
    try:
        if is_compressed(path):
            return read_compressed(path)
        header, table = _read_table(path)
    except OSError as problem:
        raise FlareFileError(f"{path} cannot be read: {problem.strerror or problem}.") from problem

    n = len(table)
    rest_names = _check_properties(path, set(header.row.names or ()))

    def columns(names: tuple[str, ...]) -> torch.Tensor:
        """Return the values (n, len(names)) of these properties, with LEGAL_INFINITIES replaced by finite numbers."""
        values: NDArray[np.float32] = np.empty((n, len(names)), np.float32)
        for column, name in enumerate(names):
            values[:, column] = table[name]
            if name in LEGAL_INFINITIES:
                low, high = LEGAL_INFINITIES[name]
                values[values[:, column] == -np.inf, column] = low
                values[values[:, column] == np.inf, column] = high
        if not np.isfinite(values).all():
            raise FlareFileError(f"{path} holds numbers that are not finite; export it again.")
        return torch.from_numpy(values)

    sh = torch.zeros(n, COEFFICIENTS, 3)
    sh[:, 0] = columns(DC)
    if rest_names:
        sh[:, 1 : 1 + len(rest_names) // 3] = columns(rest_names).reshape(n, 3, len(rest_names) // 3).transpose(1, 2)
    scene = SceneGaussians(
        columns(POSITION), columns(SCALE), columns(ROTATION), columns(("opacity",))[:, 0].clone(), sh
    )
    scene.near, scene.display_white, scene.pixel_grid = header.near, header.display_white, header.pixel_grid
    scene.antialiased, scene.far = header.antialiased, header.far
    return scene


def _read_table(path: Path) -> tuple[_Header, NDArray[Any]]:
    """Read the header and the rows of the vertices, a structured array. Raises FlareFileError and OSError."""
    with open_regular(path) as file:
        header = _parse_header(path, file.read(MAX_HEADER_BYTES))
        size = header.vertices * header.row.itemsize
        if path.stat().st_size - header.start < size:
            raise FlareFileError(f"{path} is cut short: it announces {header.vertices} Gaussians; copy it again.")
        file.seek(header.start)
        return header, np.frombuffer(file.read(size), header.row)


def _check_properties(path: Path, present: set[str]) -> tuple[str, ...]:
    """Return the names of the f_rest properties among the properties `present`. Raises FlareFileError if a property
    that Gaussians need is missing, or for a wrong number of f_rest."""
    rest_names = _rest_names(sum(name.startswith("f_rest_") for name in present))
    if len(rest_names) not in (0, 9, 24, 45):
        raise FlareFileError(
            f"{path} has {len(rest_names)} f_rest properties, where Gaussians have 0, 9, 24 or 45; export it again."
        )
    for name in (*POSITION, *DC, *rest_names, "opacity", *SCALE, *ROTATION):
        if name not in present:
            raise FlareFileError(f"{path} is not a PLY file of Gaussians: the property {name} is missing.")
    return rest_names


class _Header(NamedTuple):
    """Number of vertices, type and offset of their rows, and the values of this package's comments."""

    vertices: int
    row: np.dtype[Any]
    start: int
    near: float
    display_white: float
    pixel_grid: PixelGrid | None
    antialiased: bool
    far: FarSphere | None


def _parse_header(path: Path, head: bytes) -> _Header:
    """Parse the header of a scene's PLY, including this package's comments. Raises FlareFileError if it is no binary
    PLY whose first element is `vertex`. head: first bytes of the file; path: for messages."""
    parsed = ply.read_header(head)
    if parsed is None:
        raise FlareFileError(f"{path} is not a PLY file; name one of a scene of Gaussians.")
    if parsed.format and parsed.format not in ORDERS:
        raise FlareFileError(f"{path} is a PLY file in the format {parsed.format}; export it as binary.")
    vertices = parsed.elements[0] if parsed.elements else ply.Element("vertex", 0, [])
    if vertices.name != "vertex" or vertices.rows < 0:
        raise FlareFileError(f"{path} does not begin with its vertices; export it again.")
    try:
        names = [name for name, _ in vertices.layout()]
    except ValueError as problem:
        raise FlareFileError(f"{path} has the property {problem}, not a plain number; export it without "
                             "that.") from problem
    if not parsed.format or not names or len(set(names)) < len(names):
        raise FlareFileError(f"{path} is not a PLY file of Gaussians; export the scene as one.")
    near, display_white, pixel_grid = NEAR, 1.0, None
    far: FarSphere | None = None
    for comment in parsed.comments:  # a comment that is no number, or out of range, leaves the default
        with contextlib.suppress(ValueError):
            match comment:
                case [keyword, number] if keyword == NEAR_COMMENT:
                    near = float(number) if 0 < float(number) < NEAR else NEAR
                case [keyword, number] if keyword == WHITE_COMMENT:
                    display_white = float(number) if 1 < float(number) < MAX_WHITE else 1.0
                case [keyword, low, high] if keyword == FOCAL_COMMENT:
                    pixel_grid = PixelGrid(float(low), float(high))
                case [keyword, x, y, z, radius] if keyword == FAR_COMMENT:
                    far = FarSphere.parse(float(x), float(y), float(z), float(radius))
    antialiased = any(map(_is_mip_comment, parsed.comments))
    return _Header(vertices.rows, vertices.row(ORDERS[parsed.format]), parsed.start, near, display_white, pixel_grid,
                   antialiased, far)


def _is_mip_comment(comment: Sequence[str]) -> bool:
    """Return whether a comment names a mip filter: "SplatRenderMode: mip", "antialiased 1", "mip_filter: true"."""
    tokens = " ".join(comment).replace(":", " ").replace("=", " ").lower().split()
    if len(tokens) != 2:
        return False
    if tokens[0] in ("splatrendermode", "rendermode", "rasterize_mode", "render_mode"):
        return tokens[1] in ("mip", "mip-splatting", "antialiased")
    return tokens[0] in ("antialiased", "mip", "mip_filter", "mip_splatting") and tokens[1] in ("1", "true", "yes")
