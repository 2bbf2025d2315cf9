# SPDX-License-Identifier: GPL-3.0-or-later
"""A light of a target that shows a look's flare, and the sum of the flare over a light with an extent.

The flare of an extended light is the sum of the flares of its parts. An extent has CELLS cells, whose sizes and places
on the light never change. The flare is evaluated at the middle of each cell, with the visible share of the cell, and
each of its Gaussians is blurred by the cell as it sees the light move: the sum is smooth, and its light is the visible
light. `Look.evaluate_lights` and `core.transfer` call `evaluate_placed`.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..capture.light_extent import LightExtent
from ..choices import Blend
from ..conventions.pixel_grid import PixelGrid, dilation
from .edits import Edit, apply_colour
from .network import Floats
from .plane import PlaneGaussians, concatenate

CELL_BLUR = 2.4
"""Variance of a cell's blur relative to the cell's own: with this, a row of Gaussians is smooth."""
SMALLEST_EXTENT = 2e-4
"""Largest offset, normalised coordinates, below which an extent counts as a point: less than a pixel."""
NEAREST = 1e-2
"""Smallest distance, relative to the reference distance, that fall-off computes with."""


@dataclass(frozen=True, eq=False)
class ViewOfLight:
    """One light seen by one camera.

    camera (3,): position in the world; rotation (3, 3): world to camera; light (2,): normalised image coordinates;
    depth: of the light along the axis, world units, not positive behind the camera."""

    camera: Floats
    rotation: Floats
    light: Floats
    depth: float

    @classmethod
    def of(cls, world_to_camera: ArrayLike, xyz: ArrayLike) -> ViewOfLight:
        """Return the view of a light at xyz (3,) for a pose (4, 4), world to camera."""
        pose = np.asarray(world_to_camera, np.float64)
        x, y, z = (pose[:3, :3] @ np.asarray(xyz, np.float64) + pose[:3, 3]).tolist()
        camera = -pose[:3, :3].T @ pose[:3, 3]
        light = [x / z, y / z] if z > 0 else [math.inf, math.inf]
        return cls(camera.astype(np.float32), pose[:3, :3].astype(np.float32), np.array(light, np.float32), z)


@dataclass(frozen=True, eq=False)
class PlacedLight:
    """A light at xyz (3,) that shows the flare of the look's light `source`.

    visibility: 0..1. extent: None for a point. shares (CELLS,): visible share of each cell of the extent, 0..1, on top
    of `visibility`; None for all visible (`SampledExtent.shares`). factor: linear RGB that the flare is multiplied
    with, such as the light's power relative to its first frame. reference_distance: distance from the camera, world
    units, at which the flare has its own brightness, with inverse square fall-off; 0 for none.
    """

    name: str
    source: str
    xyz: NDArray[np.float64]
    visibility: float = 1.0
    extent: LightExtent | None = None
    shares: tuple[float, ...] | None = None
    factor: tuple[float, float, float] = (1.0, 1.0, 1.0)
    reference_distance: float = 0.0

    def cache_key(self) -> str:
        """Return a text that changes with everything that the light's flare depends on."""
        plain: tuple[Any, ...] = (self.name, self.source, self.xyz.tolist(), self.visibility)
        if self.extent is None and self.factor == (1.0, 1.0, 1.0) and not self.reference_distance:
            return repr(plain)  # the rest changes nothing here; layers that were baked with this key stay valid
        extent = None if self.extent is None else self.extent.to_json()
        return repr((*plain, extent, self.shares, self.factor, self.reference_distance))


Evaluate = Callable[[ViewOfLight, float], PlaneGaussians | None]
"""Evaluates a look for a view of a point of a light and its visibility."""


def fall_off(distance: float, reference: float) -> float:
    """Return the inverse square factor of a light's brightness, 1 at the reference distance; 1 without a reference."""
    return (reference / max(distance, NEAREST * reference)) ** 2 if reference > 0 else 1.0


def evaluate_placed(light: PlacedLight, world_to_camera: ArrayLike, blend: Blend, evaluate: Evaluate,
                    pixel_grid: PixelGrid | None = None) -> PlaneGaussians | None:
    """Return the plane Gaussians of a placed light; None if it is hidden, dark or behind the camera.

    evaluate: returns the flare of a point; None for no flare. pixel_grid: the one of the look's fit. For a light with
    an extent, the Gaussians of its visible cells follow each other, cell by cell.
    """
    if light.visibility <= 0 or not any(light.factor):
        return None
    pose = np.asarray(world_to_camera, np.float64)
    eye = -pose[:3, :3].T @ pose[:3, 3]
    if light.extent is None:
        gaussians = _evaluate_point(pose, light.xyz, light.visibility, evaluate)
        factor = fall_off(float(np.linalg.norm(light.xyz - eye)), light.reference_distance)
        return None if gaussians is None else multiply_light(gaussians, np.multiply(light.factor, factor), blend)
    return _sum_over_cells(light, light.extent, pose, eye, blend, evaluate, _low_pass_variance(pixel_grid))


def _evaluate_point(pose: NDArray[np.float64], xyz: NDArray[np.float64], visibility: float, evaluate: Evaluate
                    ) -> PlaneGaussians | None:
    """Return the flare of a point at xyz (3,); None behind the camera."""
    view = ViewOfLight.of(pose, xyz)
    return evaluate(view, visibility) if view.depth > 0 else None


def _sum_over_cells(light: PlacedLight, extent: LightExtent, pose: NDArray[np.float64], eye: NDArray[np.float64],
                    blend: Blend, evaluate: Evaluate, low_pass: float) -> PlaneGaussians | None:
    """Return the flare of a light with an extent: the sum over its cells; None if none is lit and in front.

    pose (4, 4): world to camera. eye (3,): position of the camera. low_pass: variance that the rasterizer adds to each
    Gaussian, normalised coordinates."""
    sampled = extent.sampled(light.xyz, pose)
    shares = np.ones(sampled.count) if light.shares is None else np.asarray(light.shares, np.float64)
    strengths = sampled.weights * shares * sampled.emission
    if not strengths.any():
        return None
    camera_points = (sampled.points - eye) @ pose[:3, :3].T
    # A cell is in front of the camera if all of its samples are.
    is_in_front = np.bincount(sampled.cells, camera_points[:, 2] > 0) == np.bincount(sampled.cells)
    plane = camera_points[:, :2] / np.where(camera_points[:, 2] > 0, camera_points[:, 2], np.inf)[:, None]
    centres = sampled.centres
    factors = np.array([fall_off(float(distance), light.reference_distance)
                        for distance in np.linalg.norm(centres - eye, axis=1)])[:, None] * light.factor
    if sampled.factors is not None:  # the cells are lights of their own, each with a whole flare
        factors *= sampled.factors
    elif is_in_front.all() and np.ptp(plane, axis=0).max() < 2 * SMALLEST_EXTENT:
        # Too small to be seen: evaluated once, as a point.
        gaussians = _evaluate_point(pose, centres.mean(0), light.visibility * float(strengths.sum()), evaluate)
        return None if gaussians is None else multiply_light(gaussians, factors.mean(0), blend)
    # Hidden cells are evaluated too, unless they are lights of their own: they show how the Gaussians follow the light.
    evaluated = {int(cell): part for cell in np.flatnonzero(is_in_front & (sampled.factors is None or strengths > 0))
                 if (part := _evaluate_point(pose, centres[cell], light.visibility, evaluate)) is not None}
    if not evaluated:
        return None
    motions = None
    if sampled.count < len(sampled.points):  # else a cell is one sample, and has no size to blur by
        positions = np.array([plane[sampled.cells == cell].mean(0) for cell in evaluated])
        motions = _fit_motions(list(evaluated.values()), positions)
    visible = []
    for cell, part in evaluated.items():
        if strengths[cell] > 0:
            if motions is not None:
                spread = CELL_BLUR * np.cov(plane[sampled.cells == cell].T, bias=True)
                part = _blur(part, motions, spread, low_pass)
            part = multiply_light(part, factors[cell], blend)
            visible.append(replace(part, opacities=np.asarray(part.opacities * strengths[cell], np.float32)))
    return concatenate(visible)


def multiply_light(gaussians: PlaneGaussians, factor: ArrayLike, blend: Blend) -> PlaneGaussians:
    """Return the Gaussians with their linear light multiplied by factors (3,)."""
    factors = np.asarray(factor, np.float64)
    if (factors == 1).all():
        return gaussians
    if blend == "add":
        return replace(gaussians, colours=gaussians.colours * factors.astype(np.float32))
    intensity = float(factors.max())  # not in the tint, so that with the blend "over" a factor below 1 dims opacities
    red, green, blue = (factors / intensity if intensity > 0 else factors).tolist()
    return apply_colour(gaussians, Edit(intensity=intensity, tint=(red, green, blue)), blend)


def _fit_motions(parts: Sequence[PlaneGaussians], positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how each Gaussian moves with the light (n, 2, 2), by least squares over the cells.

    parts: the flare of each cell. positions (k, 2): centres of the cells on the plane. Element [i, a, b] is the
    derivative of coordinate a of Gaussian i by coordinate b of the light."""
    means = np.stack([part.means for part in parts]).astype(np.float64)
    offsets = positions - positions.mean(0)
    # The cut-off leaves out the direction across a light that is seen as a line: there is no motion to measure.
    slopes = np.linalg.pinv(offsets, rcond=1e-3) @ (means - means.mean(0)).reshape(len(parts), -1)
    return slopes.reshape(2, -1, 2).transpose(1, 2, 0)


def _blur(gaussians: PlaneGaussians, motions: NDArray[np.float64], spread: NDArray[np.float64], low_pass: float
             ) -> PlaneGaussians:
    """Return the Gaussians blurred by a light of the covariance `spread` (2, 2); the light that they draw stays the
    same.

    motions (n, 2, 2): derivative of each Gaussian's centre by the light's position. low_pass: variance that the
    rasterizer adds. A ring has radius r and width w in standard deviations of its ellipse. It keeps the ellipse, and w
    grows by the blur's mean variance in units of the ellipse. Where r is at most w, the ellipse grows instead.
    """
    xx, xy, yy = gaussians.covariances.T.astype(np.float64)
    blur = motions @ spread @ motions.transpose(0, 2, 1)
    blur_xx, blur_yy, blur_xy = blur[:, 0, 0], blur[:, 1, 1], blur[:, 0, 1]
    is_plain = np.ones(len(gaussians), bool)
    rings = gaussians.rings
    if rings is not None:
        radius, width = rings.T.astype(np.float64)
        is_plain = radius <= width
        determinant = np.maximum(xx * yy - xy * xy, 1e-30)
        # Half the trace of the inverse covariance times the blur's.
        relative = (yy * blur_xx - 2 * xy * blur_xy + xx * blur_yy) / determinant / 2
        rings = np.stack([radius, np.where(is_plain, width, np.sqrt(width**2 + relative))], -1).astype(np.float32)
    # A plain profile has the standard deviation w times that of its ellipse.
    scale = 1.0 if rings is None else np.maximum(rings[:, 1].astype(np.float64), 1e-6) ** 2
    grown = np.stack([xx + blur_xx / scale, xy + blur_xy / scale, yy + blur_yy / scale], -1)
    covariances = np.where(is_plain[:, None], grown, gaussians.covariances).astype(np.float32)
    blurred = replace(gaussians, covariances=covariances, rings=rings)
    gain = _profile_integrals(gaussians, low_pass) / _profile_integrals(blurred, low_pass)
    return replace(blurred, opacities=np.asarray(gaussians.opacities * gain, np.float32))


def _profile_integrals(gaussians: PlaneGaussians, low_pass: float) -> NDArray[np.float64]:
    """Return the integrals (n,) of the profiles over the plane, in units of the covariances.

    Arcs are left out, since a blur hardly changes them. low_pass: variance that the rasterizer adds.

    The integral of exp(-(r - r0)^2 / (2 w^2)) over the plane is 2 pi times
    w^2 exp(-r0^2 / (2 w^2)) + r0 w sqrt(pi / 2) (1 + erf(r0 / (w sqrt 2))).
    """
    xx, xy, yy = gaussians.covariances.T.astype(np.float64)
    areas = 2 * np.pi * np.sqrt(np.maximum((xx + low_pass) * (yy + low_pass) - xy * xy, 1e-30))
    if gaussians.rings is None:
        return areas
    radius, width = gaussians.rings.T.astype(np.float64)
    ratio = radius / width / math.sqrt(2)
    profile = width * (width * np.exp(-ratio**2) + radius * math.sqrt(math.pi / 2) * (1 + _error_function(ratio)))
    return np.maximum(areas * profile, 1e-30)


def _error_function(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return erf (n,), to 1.5e-7 (Abramowitz and Stegun 1964, 7.1.26)."""
    t = 1 / (1 + 0.3275911 * np.abs(values))
    polynomial = ((((1.061405429 * t - 1.453152027) * t + 1.421413741) * t - 0.284496736) * t + 0.254829592) * t
    return np.sign(values) * (1 - polynomial * np.exp(-values**2))


def _low_pass_variance(pixel_grid: PixelGrid | None) -> float:
    """Return the variance that a rasterizer adds to Gaussians of this grid, normalised coordinates; 0 if unknown."""
    if pixel_grid is None:
        return 0.0
    focal_length = pixel_grid.min_focal_length
    return dilation(pixel_grid, focal_length) / focal_length**2
