# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes the quads of the overlay in numpy: one about each Gaussian, in the level whose resolution suffices for it.

`overlay` draws them on the GPU, and its shaders compute the profile inside each quad.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.conventions.splatting import OPACITY_MAX
from ..core.look import Look, PlaneGaussians, to_pixels
from ..core.look.drawing import cutoff_radii
from ..core.look.plane import arc_log_peak, arcs_to_pixels

LEVELS = (1, 2, 4, 8, 16)
"""Divisors of the size of the buffers, full size first."""
MIN_TEXELS = 4.0  # standard deviation of the narrow side of a Gaussian, in the level that it is drawn in

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class DrawnRegion:
    """The part of a frame that is drawn: lower left corner and size in region pixels, and the intrinsics (3, 3) of its
    pixels, with row 0 on top."""

    x: int
    y: int
    width: int
    height: int
    intrinsics: NDArray[np.float64]


@dataclass(frozen=True)
class Quads:
    """Vertices of n quads.

    place (4n, 2): pixels of the level that they are drawn in. local (4n, 2): Mahalanobis coordinates, along the long
    axis and across it. light (4n, 3): colour times opacity. ring (4n, 3): radius r0 and width w in the unit of local,
    and opacity. arc (4n, 3): vector to the brighter side in the unit of local, and the logarithm of the peak that it
    gives, which the shader subtracts. triangles (2n, 3): indices of vertices.
    """

    place: Floats
    local: Floats
    light: Floats
    ring: Floats
    arc: Floats
    triangles: NDArray[np.uint32]

    def part(self, start: int, end: int) -> Quads:
        """Return the quads from number `start` to before `end`."""
        place, local, light, ring, arc = (values[4 * start:4 * end] for values in (
            self.place, self.local, self.light, self.ring, self.arc))
        return Quads(place, local, light, ring, arc, self.triangles[:2 * (end - start)])


_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float32)
_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)


class QuadMemory:
    """Arrays that drawings of many Gaussians reuse, since the system is slow to provide large new ones.

    Quads in these arrays are valid until the next `quads_by_level` with the same memory.
    """

    def __init__(self) -> None:
        self._arrays: dict[str, Floats] = {}
        self._triangles = np.zeros((0, 3), np.uint32)

    def vertices(self, name: str, count: int, width: int) -> Floats:
        """Return an array (count, width) of any content for the attribute `name`."""
        array = self._arrays.get(name)
        if array is None or len(array) < count or array.shape[1] != width:
            array = self._arrays[name] = np.empty((count + count // 4, width), np.float32)
        return array[:count]

    def triangles(self, count: int) -> NDArray[np.uint32]:
        """Return the indices (2 count, 3) of the vertices of `count` quads; they must not be changed."""
        if len(self._triangles) < 2 * count:
            first = 4 * np.arange(count + count // 4, dtype=np.uint32)[:, None, None]
            self._triangles = np.asarray(first + _TRIANGLES, np.uint32).reshape(-1, 3)
        return self._triangles[:2 * count]


def overlay_level_indices(short: Floats, rings: Floats | None) -> NDArray[np.uint8]:
    """Return the index in LEVELS (n,) that each Gaussian is drawn in.

    short: (n,) standard deviations along the short axes, pixels. rings: (n, 2) r0 and w, or None.
    """
    texels = short / MIN_TEXELS
    if rings is not None:
        texels = texels * np.minimum(rings[:, 1], 1)  # the line of a ring is thinner than its ellipse
    return np.sum([texels >= divisor for divisor in LEVELS[1:]], 0, np.uint8)


def touches_region(centres: Floats, covariances: Floats, radii: Floats, width: int, height: int) -> NDArray[np.bool_]:
    """Return which ellipses (n,) touch a picture of this size; degenerate ones do not.

    centres (n, 2) px, covariances (n, 3) xx, xy, yy in px², radii (n,) Mahalanobis.
    """
    xx, xy, yy = covariances.T
    reach_x, reach_y = radii * np.sqrt(np.maximum(xx, 0)), radii * np.sqrt(np.maximum(yy, 0))
    x, y = centres.T
    with np.errstate(invalid="ignore"):
        return np.asarray((x + reach_x > 0) & (y + reach_y > 0) & (x - reach_x < width) & (y - reach_y < height)
                          & (xx * yy - xy * xy > 0) & (radii > 0) & np.isfinite(x + y))


def quads_by_level(gaussians: PlaneGaussians, window: DrawnRegion, look: Look, memory: QuadMemory | None = None
                   ) -> dict[int, Quads]:
    """Return the quads of the Gaussians that touch the region, by level: the divisor of the size of the buffer that
    they are drawn in. Lengths are pixels of that buffer; quads are in drawing order, with "over" back to front.

    memory: arrays to write the quads into; None for new ones.
    """
    centres, covariances = to_pixels(gaussians, window.intrinsics, look.pixel_grid)
    radii = cutoff_radii(gaussians, look.blend)
    rows = np.flatnonzero(touches_region(centres, covariances, radii, window.width, window.height))
    if look.blend == "over":  # the first is in front, so it is drawn last
        rows = rows[::-1]
    long, short, axes = _principal_axes(covariances[rows])
    if look.blend == "over":
        levels = np.zeros(len(rows), np.uint8)  # all at full size
    else:
        levels = overlay_level_indices(short, None if gaussians.rings is None else gaussians.rings[rows])
    order = np.argsort(levels, kind="stable")
    rows, long, short, axes, levels = rows[order], long[order], short[order], axes[order], levels[order]
    divisors = np.array(LEVELS, np.float32)[levels]
    ellipses = _Ellipses(centres[rows] / divisors[:, None], radii[rows], long / divisors, short / divisors, axes)
    opacities = gaussians.opacities[rows]
    if look.blend == "over":
        opacities = np.minimum(opacities, OPACITY_MAX)
    ring = np.empty((len(rows), 3), np.float32)
    ring[:, :2] = (0, 1) if gaussians.rings is None else gaussians.rings[rows]  # radius 0, width 1: a plain Gaussian
    ring[:, 2] = opacities
    arcs = None
    if gaussians.arcs is not None:
        arcs = arcs_to_pixels(gaussians, window.intrinsics)[rows] / divisors[:, None]
    quads = _make_quads(ellipses, gaussians.colours[rows] * opacities[:, None], ring, arcs, memory or QuadMemory())
    ends = np.searchsorted(levels, np.arange(len(LEVELS)), side="right").tolist()
    return {divisor: quads.part(start, end) for divisor, start, end in zip(LEVELS, [0, *ends[:-1]], ends, strict=True)
            if end > start}


@dataclass(frozen=True)
class _Ellipses:
    """Ellipses in pixels: centres (n, 2), Mahalanobis radii (n,), standard deviations along the long and short axes
    (n,), and unit vectors of the long axes (n, 2)."""

    centres: Floats
    radii: Floats
    long: Floats
    short: Floats
    axes: Floats


def _make_quads(ellipses: _Ellipses, light: Floats, ring: Floats, arcs: Floats | None, memory: QuadMemory) -> Quads:
    """Return a quad about each ellipse, in their order.

    light (n, 3): colour times opacity. ring (n, 3): r0, w and opacity. arcs (n, 2): px, or None.
    """
    count, (x, y) = len(light), ellipses.axes.T
    place, local = (memory.vertices(name, 4 * count, 2).reshape(-1, 4, 2) for name in ("place", "local"))
    along = (ellipses.radii * ellipses.long)[:, None] * ellipses.axes
    across = (ellipses.radii * ellipses.short)[:, None] * np.stack([-y, x], -1)
    diagonal, other_diagonal = along + across, along - across
    np.subtract(ellipses.centres, diagonal, out=place[:, 0])
    np.add(ellipses.centres, other_diagonal, out=place[:, 1])
    np.add(ellipses.centres, diagonal, out=place[:, 2])
    np.subtract(ellipses.centres, other_diagonal, out=place[:, 3])
    np.multiply(ellipses.radii[:, None, None], _CORNERS, out=local)
    arc = np.zeros((count, 3), np.float32)
    if arcs is not None:
        arc[:, 0] = (x * arcs[:, 0] + y * arcs[:, 1]) / np.maximum(ellipses.long, 1e-6)
        arc[:, 1] = (x * arcs[:, 1] - y * arcs[:, 0]) / np.maximum(ellipses.short, 1e-6)
        arc[:, 2] = arc_log_peak(np.hypot(arc[:, 0], arc[:, 1]), ring[:, :2])
    rows = np.repeat(np.arange(count), 4)
    of_corners = {name: np.take(values, rows, 0, out=memory.vertices(name, 4 * count, 3), mode="clip")
                  for name, values in (("light", light), ("ring", ring), ("arc", arc))}
    return Quads(place.reshape(-1, 2), local.reshape(-1, 2), triangles=memory.triangles(count), **of_corners)


def _principal_axes(covariances: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the standard deviations (n,) along the long and the short axes of ellipses, px, and the unit vectors (n,
    2) of the long axes; (-y, x) is the short one.

    covariances: (n, 3) xx, xy, yy, px².
    """
    xx, xy, yy = covariances.T
    half, root = (xx + yy) / 2, np.sqrt(((xx - yy) / 2) ** 2 + xy * xy)
    long, short = np.sqrt(np.maximum(half + root, 0)), np.sqrt(np.maximum(half - root, 0))
    cosine = (xx - yy) / np.maximum(2 * root, np.finfo(np.float32).tiny)  # of twice the angle of the long axis
    axes = np.empty((len(covariances), 2), np.float32)  # by the half-angle formulas
    axes[:, 0] = np.sqrt(np.clip((1 + cosine) / 2, 0, 1))
    axes[:, 1] = np.copysign(np.sqrt(np.clip((1 - cosine) / 2, 0, 1)), xy)
    return long, short, axes
