# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians on the normalised plane: covariances, colours, pixels; core/flare/placement.py has the torch version.

Everything is in normalised image coordinates (x/z, y/z, origin at the principal point, y down).
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..choices import Blend
from ..colour.srgb import LUMINANCE
from ..conventions.exposures import colour_scale
from ..conventions.pixel_grid import PixelGrid, dilation
from ..conventions.splatting import C0, C1, C2, C3

Floats = NDArray[np.float32]

PLANE_DEPTH = 0.21
"""Camera depth of 3D Gaussians of a flare: just past 3DGS's near plane of 0.2 (paper, appendix)."""
ARC_SOFTNESS = 0.1
"""Strength of an arc from which its opacity is that of its peak; see `opacity_gain`."""


@dataclass(frozen=True, eq=False)
class PlaneGaussians:
    """Gaussians on the normalised plane, in the form that rasterizers draw.

    means        (n, 2)
    covariances  (n, 3) xx, xy, yy
    opacities    (n,)   0..1 (blend "add": any gain >= 0)
    colours      (n, 3) display values (blend "add": linear)
    rings        (n, 2) r0 and w, or None
    arcs         (n, 2) vector from the mean towards the brighter side, or None (core/flare/placement.py)
    """

    means: Floats
    covariances: Floats
    opacities: Floats
    colours: Floats
    rings: Floats | None = None
    arcs: Floats | None = None

    def __len__(self) -> int:
        return len(self.means)

    def with_exposure(self, exposure: float, blend: Blend) -> PlaneGaussians:
        """Return the Gaussians in a frame whose exposure is a multiple of the usual one."""
        if exposure == 1:
            return self
        return replace(self, colours=np.float32(colour_scale(exposure, blend)) * self.colours)

    def select(self, rows: Any) -> PlaneGaussians:
        """Return the Gaussians of these rows (a mask or numbers)."""
        rings, arcs = (None if part is None else part[rows] for part in (self.rings, self.arcs))
        return PlaneGaussians(self.means[rows], self.covariances[rows], self.opacities[rows], self.colours[rows], rings,
                              arcs)

    @property
    def arc_strengths(self) -> Floats:
        """(n,) length of each arc in standard deviations; 0 without arcs."""
        if self.arcs is None:
            return np.zeros(len(self), np.float32)
        return arc_strengths(self.arcs, self.covariances)

    @property
    def energy(self) -> Floats:
        """(n,) luminance that each adds to the plane: opacity times the profile's area times luminance."""
        luminance = np.maximum(self.colours, 0) @ LUMINANCE.astype(np.float32)
        xx, xy, yy = self.covariances.T
        area = 2 * np.pi * np.sqrt(np.maximum(xx * yy - xy * xy, 0))
        if self.rings is not None:  # a ring's area: radius times width, that of the plain profile for r0 = 0
            r0, w = self.rings.T
            area = area * (w * w + np.sqrt(np.pi / 2) * np.maximum(r0, 0) * w)
            # The exponentials of large numbers overflow.
            exponent = np.clip(np.maximum(r0, 0) * self.arc_strengths.astype(np.float64), 0, 500)
            area = area * np.i0(exponent) * np.exp(-exponent)  # mean of the arc's factor over the ring
        return np.asarray(self.opacities * area * luminance, np.float32)


def project_covariances(means: Floats, log_scales: Floats, quaternions: Floats) -> Floats:
    """Return (n, 3) covariances xx, xy, yy on the plane of 3D Gaussians at depth PLANE_DEPTH, projected to first order
    (EWA splatting, Zwicker et al. 2002).

    means: (n, 2) on the plane. log_scales: (n, 3), world units. quaternions: (n, 4) wxyz, of any length but zero."""
    q = quaternions / np.maximum(np.linalg.norm(quaternions, axis=-1, keepdims=True), 1e-12)
    w, x, y, z = q.T
    rotation = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                         2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                         2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1).reshape(-1, 3, 3)
    scales = np.exp(log_scales) / PLANE_DEPTH
    row_x = (rotation[:, 0] - means[:, :1] * rotation[:, 2]) * scales
    row_y = (rotation[:, 1] - means[:, 1:] * rotation[:, 2]) * scales
    return np.stack([(row_x * row_x).sum(-1), (row_x * row_y).sum(-1), (row_y * row_y).sum(-1)], -1)


def covariance_of_ellipse(log_scales: Floats, directions: Floats) -> Floats:
    """Return (n, 3) covariances of ellipses: log_scales (n, 2), directions (n, 2) of the first axis, of any length."""
    c, s = (directions / np.maximum(np.linalg.norm(directions, axis=-1, keepdims=True), 1e-12)).T
    a, b = np.exp(2 * log_scales).T
    return np.stack([a * c * c + b * s * s, (a - b) * c * s, a * s * s + b * c * c], -1)


def arcs_of_ellipse(arcs: Floats, log_scales: Floats, directions: Floats) -> Floats:
    """Return (n, 2) arcs on the plane from arcs (n, 2) in standard deviations along the axes."""
    first_axis = directions / np.maximum(np.linalg.norm(directions, axis=-1, keepdims=True), 1e-12)
    along, across = (arcs * np.exp(log_scales)).T
    return along[:, None] * first_axis + across[:, None] * np.stack([-first_axis[:, 1], first_axis[:, 0]], -1)


def opacity_gain(arcs: Floats, rings: Floats) -> Floats:
    """Return (n,) factors of the opacities; arcs (n, 2) in standard deviations along the axes, rings (n, 2)
    of r0 and w.

    A profile is drawn divided by its peak, whose logarithm, about r0 |arc|, has a kink at arc 0. The factor replaces
    |arc| by a softened length that is quadratic there, so that the profile changes smoothly."""
    squared = (arcs * arcs).sum(-1)
    softened = squared / np.sqrt(squared + ARC_SOFTNESS**2)
    return np.asarray(np.exp(rings[:, 0] * (np.sqrt(squared) - softened)), np.float32)


def arc_strengths(arcs: Floats, covariances: Floats) -> Floats:
    """Return (n,) lengths of arcs (n, 2) in standard deviations of covariances (n, 3).

    Computed in float64, since the determinant of a very thin Gaussian would cancel in float32."""
    xx, xy, yy = covariances.T.astype(np.float64)
    x, y = arcs.T.astype(np.float64)
    squared = (yy * x * x - 2 * xy * x * y + xx * y * y) / np.maximum(xx * yy - xy * xy, 1e-30)
    return np.asarray(np.sqrt(np.maximum(squared, 0)), np.float32)


def colours(rays: Floats, sh: Floats, degree: int) -> Floats:
    """Return colours (n, 3) >= 0 of spherical harmonics (n, k, 3) along rays (n, 3) of any length."""
    x, y, z = (rays / np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-12)).T
    functions = [np.full_like(x, C0)]
    if degree >= 1:
        functions += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        functions += [C2[0] * x * y, -C2[0] * y * z, C2[1] * (2 * z * z - x * x - y * y), -C2[0] * x * z,
                      C2[2] * (x * x - y * y)]
    if degree >= 3:
        functions += [-C3[0] * y * (3 * x * x - y * y), C3[1] * x * y * z, -C3[2] * y * (4 * z * z - x * x - y * y),
                      C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y), -C3[2] * x * (4 * z * z - x * x - y * y),
                      C3[4] * z * (x * x - y * y), -C3[0] * x * (x * x - 3 * y * y)]
    sh_colours = np.einsum("nk,nkc->nc", np.stack(functions, -1), sh[:, :len(functions)])
    return np.maximum(sh_colours + np.float32(0.5), 0)


def to_pixels(gaussians: PlaneGaussians, intrinsics: ArrayLike,
              pixel_grid: PixelGrid | None = None) -> tuple[Floats, Floats]:
    """Return centres (n, 2), px, and covariances (n, 3), px², for intrinsics (3, 3), with the low-pass filter of the
    fit's pixel grid, or the default one if it is unknown."""
    k = np.asarray(intrinsics, np.float32)
    focal, centre = k.diagonal()[:2], k[:2, 2]
    stretch = np.array([focal[0] ** 2, focal[0] * focal[1], focal[1] ** 2], np.float32)
    variance = dilation(pixel_grid, math.sqrt(float(focal[0] * focal[1])))
    low_pass = np.array([variance, 0, variance], np.float32)
    return gaussians.means * focal + centre, gaussians.covariances * stretch + low_pass


def arcs_to_pixels(gaussians: PlaneGaussians, intrinsics: ArrayLike) -> Floats:
    """Return (n, 2) arcs in pixels for intrinsics (3, 3), 0 without arcs.

    The inverse covariance (of `to_pixels`) times an arc is b, the slope of the profile's logarithm."""
    if gaussians.arcs is None:
        return np.zeros_like(gaussians.means)
    return gaussians.arcs * np.asarray(intrinsics, np.float32).diagonal()[:2]


def arc_log_peak(strength: Any, ring: Any) -> Any:
    """Return (n,) logarithms of the peak of exp(s r - (r - r0)² / (2 w²)): a ring along its arc, which is at r0 + s w².

    strength (n,): s, the arc's length in standard deviations. ring (n, 2), or (2,) for one: r0 and w."""
    r0, w = np.asarray(ring).T
    return strength * (r0 + strength * w * w / 2)


def concatenate(sets: Sequence[PlaneGaussians]) -> PlaneGaussians | None:
    """Concatenate several sets; None for no sets. If only some sets have rings or arcs, the others get neutral ones."""
    if not sets:
        return None

    def concatenate_optional(name: str, default: Sequence[float]) -> Floats | None:
        parts = [getattr(gaussians, name) for gaussians in sets]
        if all(part is None for part in parts):
            return None
        return np.concatenate([np.tile(np.array(default, np.float32), (len(gaussians), 1)) if part is None else part
                               for gaussians, part in zip(sets, parts, strict=True)])

    means, covariances, opacities, sh_colours = (
        np.concatenate([getattr(gaussians, name) for gaussians in sets])
        for name in ("means", "covariances", "opacities", "colours"))
    return PlaneGaussians(means, covariances, opacities, sh_colours, concatenate_optional("rings", (0, 1)),
                          concatenate_optional("arcs", (0, 0)))
