# SPDX-License-Identifier: GPL-3.0-or-later
"""Traces and draws the ghosts of one light: every strong pair of reflections.

The lens is round but for its stop, so a light at field angle theta and azimuth phi is traced in the plane phi = 0 and
rotated afterwards; the stop's polygon keeps its orientation in the camera. Where the rays of a cell end on the sensor
gives the ghost's shape and brightness (the inverse of the area's change, as in Hullin et al. 2011, section 4.2); where
they crossed the stop, interpolated by pixel, gives its edge.
"""
from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..system.kernel_cache import compile_cached
from .aperture import Aperture, edge_radius
from .prescription import Prescription
from .spectrum import responses, wavelengths
from .trace import SENSOR_X, STOP_X, STRAY, WEIGHT, trace_grid

Array = NDArray[np.float64]

REFERENCE_WAVELENGTH = 0.55
"""Micrometres."""
COARSE_RAYS = 25
"""Rays along each side of the coarse grid that finds the bundle of rays which passes the lens."""
BUNDLE_MARGIN = 1.05
"""Distance from the axis, relative to rims and stop, up to which a coarse ray counts as one of the bundle."""
COARSE_EXTENT = 1.15
"""Half the side of the coarse grid, relative to the first surface's rim."""
PAIR_RAYS = 21
"""Rays along each side of the grid by which pairs of reflections are compared."""
MIN_SPREAD = 0.02
"""Added to the extent of a ghost on the sensor when pairs are compared, relative to the focal length."""
EDGE_SECTORS = 720
"""Sectors of the stop's edge: half a degree each."""
MAX_SUPERSAMPLED_WIDTH = 1300
"""Width in pixels above which ghosts are not supersampled."""
MAX_DENSITY = 40.0
"""Largest density of light; where rays cross (caustics) it would be unbounded."""
MAX_STRAY = 1.02
"""Distance of a ray outside the rims, relative to them, above which its cell is not drawn; below, the edge is drawn."""
MIN_EDGE, MAX_EDGE = 0.004, 0.6
"""Bounds of the width of a ghost's edge, relative to the stop's radius."""
RIM_WIDTH_SQUARED = 0.0036
"""Square of the width of the bright rim inside a ghost's edge, relative to the stop's radius."""


@dataclass(frozen=True)
class GhostSettings:
    """How ghosts are drawn. count: number of ghosts, the brightest first. grid: rays along each side of the grid.
    bands: number of wavelengths. gain: factor of their light. rim: how much brighter the edge is than the inside
    (diffraction at the stop). size: standard deviation (tan) of the blur by the extent of the light. supersample:
    samples along each side of a pixel. limit: largest light of a pixel in any channel; infinite where a sensor that
    saturates is applied later."""

    count: int = 22
    grid: int = 40
    bands: int = 9
    gain: float = 1.0
    rim: float = 0.35
    size: float = 0.0014
    supersample: int = 2
    limit: float = math.inf


@dataclass(frozen=True)
class Optics:
    """A lens in use: its prescription, coatings (micrometres per surface, 0 for bare), and its stop."""

    lens: Prescription
    coating: Array
    aperture: Aperture

    @property
    def sensor(self) -> float:
        """z of the sensor, focused at infinity."""
        return float(self.lens.vertices[-1] + self.lens.back_focus())

    def brightest_pairs(self, count: int, slope: float = 0.12) -> list[tuple[int, int]]:
        """Return the `count` pairs (first, second) of surfaces whose ghosts have the most light per area on the sensor.

        Each ghost is traced as a grid of rays. slope: tan of the field angle of the light for which they are
        compared."""
        surfaces = _trace_arguments(self, REFERENCE_WAVELENGTH)
        reflecting = [index for index in range(len(self.coating)) if index != self.lens.stop]
        scored_pairs = []
        axis = np.linspace(-1, 1, PAIR_RAYS) * self.lens.semi_aperture[0]
        for i, first in enumerate(reflecting):
            for second in reflecting[i + 1:]:
                rays, arrived = trace_grid(axis, axis, slope, first, second, *surfaces)
                radius = np.hypot(rays[..., STOP_X::2], rays[..., STOP_X + 1::2]).max(axis=-1)
                passes = arrived & (rays[..., STRAY] < 1) & (radius < self.aperture.radius)
                if passes.sum() < 2:
                    continue
                # A ghost in focus has no area; the added length keeps it from outranking all others.
                spread = np.ptp(rays[passes][:, :2], axis=0).max() + MIN_SPREAD * self.lens.focal_length()
                scored_pairs.append((rays[passes][:, WEIGHT].sum() / spread**2, first, second))
        return [(first, second) for _, first, second in sorted(scored_pairs, reverse=True)[:count]]


def coatings(lens: Prescription, design: tuple[float, ...], cemented: float = 0.0) -> Array:
    """Return the coating of each surface (n,), as the wavelength for which it is a quarter wave thick, micrometres.

    The wavelengths of `design` take turns over the surfaces between glass and air; all other surfaces get `cemented`,
    0 for none.
    """
    coating = np.full(len(lens.index), cemented)
    previous, design_index = 1.0, 0
    for index, glass in enumerate(lens.index):
        if index != lens.stop and (previous == 1.0) != (glass == 1.0):
            coating[index] = design[design_index % len(design)]
            design_index += 1
        previous = glass
    return coating


@compile_cached
def _non_negative_span(start: float, slope: float, left: float, right: float) -> tuple[float, float]:
    """Return the part (first, last) of the range left..right of u in which start + slope u is not negative.

    If there is none, first > last."""
    if slope > 0.0:
        return max(left, -start / slope), right
    if slope < 0.0:
        return left, min(right, -start / slope)
    return (left, right) if start >= 0.0 else (1.0, 0.0)


@compile_cached
def _draw_cells(rays: Array, arrived: NDArray[np.bool_], px: Array, py: Array, light: Array, stop_x: Array,
                stop_y: Array, radius: float, edges: Array, rim: float, colour: Array,
                picture: NDArray[np.float32]) -> None:
    """Add the cells of a traced grid to `picture`, each as two triangles.

    Light and stop positions are interpolated linearly between a triangle's corners; a pixel is drawn where its ray
    passes the stop inside its edge.

    rays: (rows, columns, FIELDS). arrived: True for rays that reach the sensor. px, py: where they reach it, pixels.
    light: density of light at each ray. stop_x, stop_y: (rows, columns, 3), place of up to three passages of the stop,
    mm; missing ones repeat the first. radius: of the stop, mm. edges (sectors,): distance of the stop's edge from its
    centre, relative to `radius`, in equal sectors of the angle from +x. rim: how much brighter a ghost's edge is than
    its inside. colour (3,): of this wavelength.
    """
    rows, columns = px.shape
    height, width = picture.shape[0], picture.shape[1]
    sectors = edges.shape[0]
    for row in range(rows - 1):
        for column in range(columns - 1):
            for triangle in range(2):
                r0, c0 = row, column
                if triangle == 0:
                    r1, c1, r2, c2 = row, column + 1, row + 1, column + 1
                else:
                    r1, c1, r2, c2 = row + 1, column + 1, row + 1, column
                if not (arrived[r0, c0] and arrived[r1, c1] and arrived[r2, c2]):
                    continue
                if min(rays[r0, c0, STRAY], rays[r1, c1, STRAY], rays[r2, c2, STRAY]) > MAX_STRAY:
                    continue
                x0, y0, x1, y1, x2, y2 = px[r0, c0], py[r0, c0], px[r1, c1], py[r1, c1], px[r2, c2], py[r2, c2]
                low_x, high_x = min(x0, x1, x2), max(x0, x1, x2)
                low_y, high_y = min(y0, y1, y2), max(y0, y1, y2)
                if high_x < 0 or high_y < 0 or low_x > width or low_y > height:
                    continue
                area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
                if area == 0.0:
                    continue
                # The edge's width is the distance on the stop, relative to its radius, that one pixel covers.
                s0x, s0y = stop_x[r0, c0, 0], stop_y[r0, c0, 0]
                stop_area = ((stop_x[r1, c1, 0] - s0x) * (stop_y[r2, c2, 0] - s0y)
                             - (stop_x[r2, c2, 0] - s0x) * (stop_y[r1, c1, 0] - s0y))
                ramp = math.sqrt(abs(stop_area / area)) / radius
                ramp = min(max(ramp, MIN_EDGE), MAX_EDGE)
                slope1, slope2 = (y2 - y0) / area, (y0 - y1) / area
                for y in range(max(0, math.ceil(low_y - 0.5)), min(height - 1, math.floor(high_y - 0.5)) + 1):
                    # Barycentric coordinates run linearly along a row: b = start + slope u, u and v from (x0, y0).
                    v = y + 0.5 - y0
                    start1, start2 = (x0 - x2) * v / area, (x1 - x0) * v / area
                    left, right = _non_negative_span(start1, slope1, low_x - x0, high_x - x0)
                    left, right = _non_negative_span(start2, slope2, left, right)
                    left, right = _non_negative_span(1.0 - start1 - start2, -slope1 - slope2, left, right)
                    first = max(0, math.ceil(left + x0 - 0.5))
                    for x in range(first, min(width - 1, math.floor(right + x0 - 0.5)) + 1):
                        u = x + 0.5 - x0
                        b1, b2 = start1 + slope1 * u, start2 + slope2 * u
                        b0 = 1.0 - b1 - b2
                        stray = b0 * rays[r0, c0, STRAY] + b1 * rays[r1, c1, STRAY] + b2 * rays[r2, c2, STRAY]
                        mask = min(max((1.0 - stray) / ramp + 0.5, 0.0), 1.0)
                        if mask == 0.0:
                            continue
                        rim_glow = 0.0
                        # Up to three passages of the stop; missing ones repeat the first.
                        for passage in range(3):
                            if passage > 0 and stop_x[r0, c0, passage] == s0x:
                                break
                            sx = (b0 * stop_x[r0, c0, passage] + b1 * stop_x[r1, c1, passage]
                                  + b2 * stop_x[r2, c2, passage])
                            sy = (b0 * stop_y[r0, c0, passage] + b1 * stop_y[r1, c1, passage]
                                  + b2 * stop_y[r2, c2, passage])
                            angle = (math.atan2(sy, sx) / (2.0 * math.pi) % 1.0) * sectors
                            low = int(angle)
                            part = angle - low
                            edge = edges[low % sectors] * (1.0 - part) + edges[(low + 1) % sectors] * part
                            inside = edge - math.sqrt(sx * sx + sy * sy) / radius
                            mask *= min(max(inside / ramp + 0.5, 0.0), 1.0)
                            rim_glow = max(rim_glow, math.exp(-(inside * inside) / (RIM_WIDTH_SQUARED + ramp * ramp)))
                        if mask == 0.0:
                            continue
                        value = mask * (1.0 + rim * rim_glow)
                        value *= b0 * light[r0, c0] + b1 * light[r1, c1] + b2 * light[r2, c2]
                        for channel in range(3):
                            picture[y, x, channel] += value * colour[channel]


def _density(x: Array, y: Array, cell: float) -> Array:
    """Return the density of light (rows, columns) at each ray of a grid, at most MAX_DENSITY.

    It is the area of the ray's cell at the front of the lens divided by the cell's area on the sensor, tan^2. x, y:
    (rows, columns), where the rays meet the sensor, tan. cell: area of a cell at the front, relative to pi f^2."""
    xr, xc = np.gradient(x)
    yr, yc = np.gradient(y)
    stretch = (xr * yc - xc * yr) / cell
    return 1.0 / np.sqrt(stretch**2 + MAX_DENSITY**-2)


def draw_ghosts(optics: Optics, pairs: list[tuple[int, int]], settings: GhostSettings, light: tuple[float, float],
                focal: tuple[float, float], centre: tuple[float, float], width: int, height: int
                ) -> NDArray[np.float32]:
    """Return linear light (height, width, 3) of the ghosts of a white light of strength 1.

    Each ghost is traced as a grid of rays at each wavelength, and its cells are drawn. pairs: the two reflecting
    surfaces of each ghost. light: normalised coordinates (x/z, y/z). focal, centre: focal lengths and principal point,
    pixels.
    """
    supersample = max(1, min(settings.supersample, MAX_SUPERSAMPLED_WIDTH // width))
    picture = np.zeros((height * supersample, width * supersample, 3), np.float32)
    lens = optics.lens
    focal_length = lens.focal_length()
    slope = math.hypot(*light)
    azimuth = math.atan2(light[1], light[0])
    cosine, sine = math.cos(azimuth), math.sin(azimuth)
    edges = edge_radius(optics.aperture, EDGE_SECTORS)
    bands = responses(settings.bands)
    surfaces = _trace_arguments(optics, REFERENCE_WAVELENGTH)
    grids = {pair: _find_bundle(optics, slope, pair, surfaces, settings.grid) for pair in pairs}
    for band, wavelength in enumerate(wavelengths(settings.bands)):
        surfaces = _trace_arguments(optics, wavelength)
        for pair, grid in grids.items():
            if grid is None:
                continue
            rays, arrived = trace_grid(*grid, slope, *pair, *surfaces)
            # The sensor's picture is upside down; set it upright and turn it to the light's azimuth.
            x, y = -rays[..., SENSOR_X] / focal_length, -rays[..., SENSOR_X + 1] / focal_length
            cell_area = (grid[0][1] - grid[0][0]) * (grid[1][1] - grid[1][0]) / (math.pi * focal_length**2)
            # Divided by the root, that is, times the cosine of the field angle at which the beam enters.
            density = _density(x, y, cell_area) * rays[..., WEIGHT] / math.sqrt(1 + slope**2)
            px = supersample * (centre[0] + focal[0] * (cosine * x - sine * y))
            py = supersample * (centre[1] + focal[1] * (sine * x + cosine * y))
            stop_x, stop_y = rays[..., STOP_X::2], rays[..., STOP_X + 1::2]
            _draw_cells(rays, arrived, px, py, density, cosine * stop_x - sine * stop_y,
                        sine * stop_x + cosine * stop_y, optics.aperture.radius, edges, settings.rim, bands[band],
                        picture)
    # OpenCV needs a blur above 0.
    blurred = cv2.GaussianBlur(picture, (0, 0), max(settings.size * focal[0] * supersample, 0.3))
    reduced = cv2.resize(blurred, (width, height), interpolation=cv2.INTER_AREA)
    return limit_brightness((reduced * np.float32(settings.gain)).astype(np.float32), settings.limit)


def limit_brightness(light: NDArray[np.float32], limit: float) -> NDArray[np.float32]:
    """Return light (..., 3) with pixels of which a channel exceeds `limit` dimmed to it, in the same hue.

    If none does, the same array is returned.
    """
    brightest = light.max(-1, keepdims=True)
    if not (brightest > np.float32(limit)).any():
        return light
    return np.asarray(light * np.minimum(limit / np.maximum(brightest, 1e-6), 1), np.float32)


def _trace_arguments(optics: Optics, wavelength: float) -> tuple[Any, ...]:
    """Return the arguments of `trace_grid` that describe the lens at a wavelength."""
    lens = optics.lens
    return (lens.curvature, lens.vertices, lens.indices(wavelength), lens.semi_aperture, optics.coating, lens.stop,
            optics.sensor, wavelength)


def _find_bundle(optics: Optics, slope: float, pair: tuple[int, int], surfaces: tuple[Any, ...], grid: int
            ) -> tuple[Array, Array] | None:
    """Return x and y of a grid of rays that covers the bundle which passes the lens; None if no ray passes.

    The bundle is found with a coarse grid: it spans the rays that pass, or nearly do, plus one cell on each side.
    slope: tan of the field angle. surfaces: the arguments from `_trace_arguments`. grid: rays along each side of the
    result."""
    # Oblique rays may meet the plane of the first vertex outside the rim of the first surface.
    extent = COARSE_EXTENT * optics.lens.semi_aperture[0]
    axis = np.linspace(-extent, extent, COARSE_RAYS)
    rays, arrived = trace_grid(axis, axis, slope, *pair, *surfaces)
    radius = np.hypot(rays[..., STOP_X::2], rays[..., STOP_X + 1::2]).max(axis=-1)
    passes = arrived & (rays[..., STRAY] < BUNDLE_MARGIN) & (radius < BUNDLE_MARGIN * optics.aperture.radius)
    if not passes.any():
        return None
    spacing = axis[1] - axis[0]
    rows, columns = np.flatnonzero(passes.any(axis=1)), np.flatnonzero(passes.any(axis=0))
    return (np.linspace(axis[columns[0]] - spacing, axis[columns[-1]] + spacing, grid),
            np.linspace(axis[rows[0]] - spacing, axis[rows[-1]] + spacing, grid))
