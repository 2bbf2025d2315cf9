# SPDX-License-Identifier: GPL-3.0-or-later
"""The extent of a light: a rectangle, ellipse, sphere, or points on a mesh or curve, with fixed sample points.

`core.look.area` sums a flare over an extent; lights.json and shot files store one. In JSON, lengths are world units:

    {"shape": "rectangle", "axes": [[x, y, z], [x, y, z]], "one_sided": true}    half the width, half the height
    {"shape": "ellipse", "axes": [[x, y, z], [x, y, z]]}                         the two half axes
    {"shape": "sphere", "radius": 0.1}
    {"shape": "points", "points": [[x, y, z], ...]}                              offsets from the light's position
    {"shape": "points", "points": [...], "factors": [[r, g, b], ...]}            each a light of its own factor

A one-sided extent emits to the side of axes[0] x axes[1], with the cosine of Lambert's law; any other emits alike in
all directions. The samples are fixed in the coordinates of the light, so nothing flickers when it moves. They are
grouped into cells. A renderer finds which samples are visible (`SampledExtent.points`), and `SampledExtent.shares`
gives the visible share of each cell. Needs numpy alone.
"""
from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Shape = Literal["rectangle", "ellipse", "sphere", "points"]

CELLS = 16
"""Number of cells of an extent: a flare is evaluated once for each. A power of two."""
SAMPLES = 256
"""Number of samples of an extent, the same number in each cell. A power of two."""
MAX_POINTS = 4096
"""Most points of an extent of points."""
MAX_FACTORS = 1024
"""Most points of an extent with a factor for each."""
MAX_LENGTH = 1e9
"""Largest length of an extent, world units."""


@dataclass(frozen=True, eq=False)
class SampledExtent:
    """The samples of a light's extent as one camera sees them.

    points (m, 3): positions in the world. cells (m,): the cell of each, numbered from 0. emission: 0..1, the cosine of
    a one-sided light, else 1. factors (cells, 3): linear RGB of each cell, if the cells are lights of their own.
    """

    points: Floats
    cells: NDArray[np.int64]
    emission: float = 1.0
    factors: Floats | None = None

    @property
    def count(self) -> int:
        """Number of cells."""
        return int(self.cells[-1]) + 1

    def shares(self, visible: ArrayLike) -> Floats:
        """Return the visible share of each cell (cells,), 0..1, from the visibility of each sample (m,), 0..1."""
        values = np.broadcast_to(np.asarray(visible, np.float64), self.cells.shape)
        return np.bincount(self.cells, values) / np.bincount(self.cells)

    @property
    def centres(self) -> Floats:
        """(cells, 3) mean position of each cell."""
        counts = np.bincount(self.cells)
        return np.stack([np.bincount(self.cells, column) for column in self.points.T], -1) / counts[:, None]

    @property
    def weights(self) -> Floats:
        """(cells,) part of the light in each cell; they sum to 1, unless the cells are lights of their own."""
        if self.factors is not None:
            return np.ones(self.count)
        return np.bincount(self.cells) / len(self.cells)


@dataclass(frozen=True, eq=False)
class LightExtent:
    """An extent around a light's position; see the module's head. Make one with `rectangle`, `ellipse`, `sphere`,
    `of_points`, or `from_json`.

    axes (2, 3): half axes of a rectangle or ellipse. radius: of a sphere. points (n, 3): offsets of the points, ordered
    so that neighbours are beside each other. factors (n, 3): None, or linear RGB of each point; each point is then a
    cell of its own, with a whole flare.
    """

    shape: Shape
    axes: Floats = field(default_factory=lambda: np.zeros((2, 3)))
    radius: float = 0.0
    points: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    one_sided: bool = False
    factors: Floats | None = None

    @classmethod
    def rectangle(cls, axes: ArrayLike, *, one_sided: bool = False) -> LightExtent:
        """Return a rectangle; axes (2, 3): half its width and half its height, world units."""
        return cls("rectangle", axes=np.array(axes, np.float64), one_sided=one_sided)._checked()

    @classmethod
    def ellipse(cls, axes: ArrayLike, *, one_sided: bool = False) -> LightExtent:
        """Return an ellipse or a disc; axes (2, 3): its half axes, world units."""
        return cls("ellipse", axes=np.array(axes, np.float64), one_sided=one_sided)._checked()

    @classmethod
    def sphere(cls, radius: float) -> LightExtent:
        """Return a sphere, which every camera sees as a disc."""
        return cls("sphere", radius=float(radius))._checked()

    @classmethod
    def of_points(cls, points: ArrayLike, factors: ArrayLike | None = None) -> LightExtent:
        """Return points of equal strength; points (n, 3): offsets from the light's position, neighbours beside each
        other, as `sample_surface` and `sample_curve` return them. factors (n, 3): linear RGB, which makes each point a
        light of its own."""
        return cls("points", points=np.array(points, np.float64),
                   factors=None if factors is None else np.array(factors, np.float64))._checked()

    @classmethod
    def from_json(cls, entry: Any) -> LightExtent:
        """Read an extent from its JSON form, as in the module's head. Raises ValueError that says what is wrong."""
        if not isinstance(entry, Mapping) or entry.get("shape") not in get_args(Shape):
            raise ValueError(f"the extent of a light needs a shape: {', '.join(get_args(Shape))}")
        if not isinstance(entry.get("one_sided", False), bool):
            raise ValueError("one_sided of an extent is true or false")
        try:
            return cls(entry["shape"], np.array(entry.get("axes", np.zeros((2, 3))), np.float64),
                       float(entry.get("radius", 0)), np.array(entry.get("points", np.zeros((0, 3))), np.float64),
                       entry.get("one_sided", False),
                       np.array(entry["factors"], np.float64) if entry.get("factors") is not None else None)._checked()
        except TypeError as problem:
            raise ValueError(f"the extent of a light is not valid ({problem})") from problem

    def to_json(self) -> dict[str, Any]:
        """Return the JSON form."""
        by_shape: dict[str, Any] = {"sphere": {"radius": self.radius}, "points": {"points": self.points.tolist()}}
        others: dict[str, Any] = {"one_sided": True} if self.one_sided else {}
        if self.factors is not None:
            others["factors"] = self.factors.tolist()
        return {"shape": self.shape, **by_shape.get(self.shape, {"axes": self.axes.tolist()}), **others}

    @property
    def cell_count(self) -> int:
        """Number of cells, and of the visible shares of a light with this extent."""
        if self.shape != "points":
            return CELLS
        return min(CELLS, len(self.points)) if self.factors is None else len(self.points)

    def transformed(self, matrix: ArrayLike) -> LightExtent:
        """Return the extent under a linear map (3, 3), such as the rotation and scale of another world.

        A sphere stays a sphere: its radius grows by the map's mean scale. The side that a one-sided extent emits to is
        mapped too. A map that mirrors reorders the samples: visible shares of the original do not hold afterwards.
        """
        linear = np.asarray(matrix, np.float64)
        determinant = float(np.linalg.det(linear))
        scale, axes = abs(determinant) ** (1 / 3), self.axes @ linear.T
        if self.one_sided and determinant < 0:
            axes[0] *= -1  # a mirroring map turns the cross product of the axes to the other side
        return LightExtent(self.shape, axes, self.radius * scale, self.points @ linear.T,
                           self.one_sided, self.factors)._checked()

    def sampled(self, xyz: ArrayLike, world_to_camera: ArrayLike) -> SampledExtent:
        """Return sample points of the extent around a light at xyz (3,), and their cells, as a camera with this pose
        (4, 4) sees it."""
        centre, pose = np.asarray(xyz, np.float64), np.asarray(world_to_camera, np.float64)
        eye = -pose[:3, :3].T @ pose[:3, 3]
        if self.shape == "points":
            indices = np.arange(len(self.points))
            cells = indices * self.cell_count // len(indices)  # neighbours are beside each other: cells are runs
            return SampledExtent(centre + self.points, cells, 1.0, self.factors)
        axes, emission = self.axes, 1.0
        if self.shape == "sphere":
            axes = self.radius * _facing_axes(centre - eye, pose)
        elif self.one_sided:
            emission = _cosine(np.cross(*axes), eye - centre)
        width, height = (float(np.linalg.norm(axis)) for axis in axes)
        square, cells = _square_samples(_column_count(width / max(height, 1e-12)))
        if self.shape != "rectangle":
            square = _square_to_disc(square)
        return SampledExtent(centre + square @ axes, cells, emission)

    def _checked(self) -> LightExtent:
        """Return this extent, or raise ValueError if the numbers of its shape are not valid."""
        if self.shape == "points":
            if self.points.ndim != 2 or self.points.shape[1:] != (3,) or not 1 <= len(self.points) <= MAX_POINTS:
                raise ValueError(f"an extent of points needs 1 to {MAX_POINTS} points of three numbers")
            is_valid = bool((np.abs(self.points) < MAX_LENGTH).all())
            factors = np.zeros((len(self.points), 3)) if self.factors is None else self.factors
            if factors.shape != self.points.shape or (self.factors is not None and len(factors) > MAX_FACTORS):
                raise ValueError(f"factors are three numbers for each point, of at most {MAX_FACTORS} points")
            is_valid = is_valid and bool(((factors >= 0) & (factors < MAX_LENGTH)).all())
        elif self.shape == "sphere":
            is_valid = 0 <= self.radius < MAX_LENGTH
        else:
            if self.axes.shape != (2, 3):
                raise ValueError(f"the extent of a light, a {self.shape}, needs two axes of three numbers")
            is_valid = bool((np.abs(self.axes) < MAX_LENGTH).all())
        if not is_valid:
            raise ValueError("the extent of a light has a length that is negative, too large or not finite")
        return self


def sample_surface(vertices: ArrayLike, triangles: ArrayLike, count: int = SAMPLES, *,
                   reference: ArrayLike | None = None) -> Floats:
    """Return points (count, 3) spread evenly over a surface, for `LightExtent.of_points`.

    Triangles are drawn in proportion to their areas, and Halton's sequence places a point in each. vertices (v, 3),
    triangles (t, 3): indices of vertices. reference (v, 3): the vertices at rest, by default the vertices; the points
    are chosen there, so that each stays in its place on a surface that bends or moves. Raises ValueError for a surface
    without area.
    """
    positions, indices = np.asarray(vertices, np.float64), np.asarray(triangles, np.int64).reshape(-1, 3)
    rest_positions = positions if reference is None else np.asarray(reference, np.float64)  # the vertices at rest
    a, b, c = (rest_positions[indices[:, corner]] for corner in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    if not len(indices) or not 0 < areas.sum() < math.inf:
        raise ValueError("the surface of the light has no area")
    order = _morton_order((a + b + c) / 3)
    cumulative_areas = np.cumsum(areas[order])
    # Equal steps of area choose the triangles, in an order in which neighbours are near each other.
    sample_numbers = np.arange(count)
    ranks = np.searchsorted(cumulative_areas, (sample_numbers + 0.5) / count * cumulative_areas[-1], side="right")
    chosen = order[np.minimum(ranks, len(order) - 1)]
    u, v = _radical_inverse(sample_numbers + 1, 2), _radical_inverse(sample_numbers + 1, 3)
    sqrt_u = np.sqrt(u)  # uniform over a triangle (Osada et al. 2002)
    barycentric = np.stack([1 - sqrt_u, sqrt_u * (1 - v), sqrt_u * v], -1)[:, :, None]
    at_rest = (barycentric * rest_positions[indices[chosen]]).sum(1)
    return np.asarray((barycentric * positions[indices[chosen]]).sum(1)[_morton_order(at_rest)], np.float64)


def sample_curve(points: ArrayLike, count: int = SAMPLES) -> Floats:
    """Return points (count, 3) spread evenly along a polyline (n, 3), for `LightExtent.of_points`.

    Raises ValueError for a curve without length."""
    corners = np.asarray(points, np.float64).reshape(-1, 3)
    arc_lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    if len(corners) < 2 or not 0 < arc_lengths[-1] < math.inf:
        raise ValueError("the curve of the light has no length")
    distances = (np.arange(count) + 0.5) / count * arc_lengths[-1]
    return np.stack([np.interp(distances, arc_lengths, column) for column in corners.T], -1)


def _morton_order(points: Floats) -> NDArray[np.int64]:
    """Return indices (n,) that sort points (n, 3) by Morton code (bits of x, y, z interleaved), so that neighbours
    are near each other."""
    low, size = points.min(0), float(np.ptp(points, axis=0).max()) or 1.0
    grid = np.minimum((points - low) / size * 1024, 1023).astype(np.int64)
    morton_code = np.zeros(len(points), np.int64)
    for bit in range(10):
        for axis in range(3):
            morton_code |= (grid[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(morton_code, kind="stable")


def _column_count(aspect: float) -> int:
    """Return the number of cells along the first axis, so that cells are about as wide as high.

    It is the power of two next to sqrt(CELLS aspect), from 1 to CELLS. aspect: width of the extent over its height.
    """
    bits = round(math.log2(CELLS))
    return int(2 ** min(max(round((bits + math.log2(max(aspect, 1e-12))) / 2), 0), bits))


@lru_cache(maxsize=8)
def _square_samples(columns: int) -> tuple[Floats, NDArray[np.int64]]:
    """Return samples (m, 2) of the square -1..1, cell by cell, and their cells (m,), for `columns` cells in a row.

    Hammersley's points: each cell of any such grid has the same number, and each of SAMPLES columns or rows has one,
    so that the visible share of a light behind bars is accurate."""
    sample_numbers = np.arange(SAMPLES)
    unit = np.stack([(sample_numbers + 0.5) / SAMPLES, _radical_inverse(sample_numbers, 2) + 0.5 / SAMPLES], -1)
    cells = (unit[:, 1] * (CELLS // columns)).astype(np.int64) * columns + (unit[:, 0] * columns).astype(np.int64)
    order = np.argsort(cells, kind="stable")
    return 2 * unit[order] - 1, cells[order]


def _radical_inverse(numbers: NDArray[Any], base: int) -> Floats:
    """Return Van der Corput's sequence (n,), 0..1, at these numbers."""
    values, factor, remaining = np.zeros(len(numbers)), 1.0, np.array(numbers, np.int64)
    while remaining.any():
        factor /= base
        values += factor * (remaining % base)
        remaining //= base
    return values


def _square_to_disc(square: Floats) -> Floats:
    """Return points (n, 2) of the unit disc from points of the square -1..1, with equal areas (Shirley and Chiu
    1997)."""
    x, y = square.T
    is_wide = np.abs(x) > np.abs(y)
    radius = np.where(is_wide, x, y)
    safe = np.where(radius == 0, 1.0, radius)
    angle = np.where(is_wide, math.pi / 4 * y / safe, math.pi / 2 - math.pi / 4 * x / safe)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)


def _facing_axes(direction: Floats, pose: Floats) -> Floats:
    """Return two unit vectors (2, 3) at right angles to a direction (3,); they follow the camera's axes."""
    forward = direction / max(float(np.linalg.norm(direction)), 1e-12)
    down = pose[1, :3]
    if np.linalg.norm(np.cross(down, forward)) < 1e-3:  # a light at right angles to the view, which no frame shows
        down = pose[2, :3]
    right = np.cross(down, forward)
    right /= max(float(np.linalg.norm(right)), 1e-12)
    return np.stack([right, np.cross(forward, right)])


def _cosine(normal: Floats, direction: Floats) -> float:
    """Return the cosine of the angle between two vectors (3,), 0 for an obtuse one; 1 if one has no length."""
    lengths = float(np.linalg.norm(normal) * np.linalg.norm(direction))
    return max(float(normal @ direction) / lengths, 0.0) if lengths > 0 else 1.0
