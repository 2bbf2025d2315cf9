# SPDX-License-Identifier: GPL-3.0-or-later
"""Traces rays through a lens that are reflected twice on their way: the ghosts of Hullin et al. 2011.

"Physically-Based Real-Time Lens Flare Rendering": a parallel beam enters the lens as a grid of rays; for a pair of
surfaces (i, j), i < j, each ray is refracted up to j, reflected there, returns to i, is reflected again and continues
to the sensor. A ray records where it met the stop, how far outside any surface's rim it strayed, and how much light
Fresnel's equations leave it. The grid's cells, stretched or squeezed on the sensor, give the density of light.

Axes: z from the front towards the sensor, the first vertex at 0, lengths in mm.
"""
from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..system.kernel_cache import compile_cached

Array = NDArray[np.float64]

COATING_INDEX = 1.38
"""Refractive index of magnesium fluoride."""

# Indices of a traced ray's numbers.
SENSOR_X, SENSOR_Y, STRAY, WEIGHT = 0, 1, 2, 3
STOP_X, STOP_Y = 4, 5
FIELDS = 10
"""Length of a traced ray's array: the first four of these indices, then x and y of three passages through the stop."""


@compile_cached
def reflectance(cosine: float, n0: float, n2: float, wavelength: float, coating: float) -> float:
    """Return the unpolarised reflectance of light that comes from n0 and meets n2; 1 for total reflection.

    By Fresnel's equations for one thin film: R = |(r01 + r12 e^{i d}) / (1 + r01 r12 e^{i d})|^2 for each polarisation,
    with r01 and r12 the amplitudes reflected at the layer's two sides and d the phase gained in it. The layer has the
    index that reflects least, sqrt(n0 n2), but at least that of magnesium fluoride.

    cosine: of the angle of incidence. coating: wavelength (micrometres) for which the layer is a quarter wave thick; 0
    for bare glass.
    """
    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
    s2 = sine * n0 / n2
    if s2 >= 1.0:
        return 1.0
    c2 = math.sqrt(1.0 - s2 * s2)
    if coating <= 0.0:
        r_s = (n0 * cosine - n2 * c2) / (n0 * cosine + n2 * c2)
        r_p = (n2 * cosine - n0 * c2) / (n2 * cosine + n0 * c2)
        return 0.5 * (r_s * r_s + r_p * r_p)
    n1 = max(math.sqrt(n0 * n2), COATING_INDEX)
    s1 = sine * n0 / n1
    if s1 >= 1.0:
        return 1.0
    c1 = math.sqrt(1.0 - s1 * s1)
    phase_cosine = math.cos(math.pi * coating / wavelength * c1)  # the layer is coating / (4 n1) thick
    total = 0.0
    for polarisation in range(2):
        if polarisation == 0:
            r01 = (n0 * cosine - n1 * c1) / (n0 * cosine + n1 * c1)
            r12 = (n1 * c1 - n2 * c2) / (n1 * c1 + n2 * c2)
        else:
            r01 = (n1 * cosine - n0 * c1) / (n1 * cosine + n0 * c1)
            r12 = (n2 * c1 - n1 * c2) / (n2 * c1 + n1 * c2)
        product = r01 * r12
        numerator = r01 * r01 + r12 * r12 + 2.0 * product * phase_cosine
        total += numerator / (1.0 + product * product + 2.0 * product * phase_cosine)
    return max(0.5 * total, 0.0)  # where the two waves cancel, rounding may fall below zero


@compile_cached
def trace_ray(x: float, y: float, slope: float, first: int, second: int, curvature: Array, vertices: Array,
              index: Array, semi_aperture: Array, coating: Array, stop: int, sensor: float, wavelength: float,
              out: Array) -> bool:
    """Trace one ray that meets the plane z = 0 at (x, y), from a light at tan(field angle) = `slope` along +x.

    Returns False if the ray misses a surface or is reflected totally; else `out` (FIELDS,) receives the result. first <
    second: the pair of surfaces that reflects; both -1 for none. curvature, vertices, index, semi_aperture (n,): those
    of the surfaces, as a `Prescription` has them. coating (n,): wavelength, micrometres, for which a surface's layer is
    a quarter wave thick, 0 for bare glass. stop: index of the stop. sensor: z of the sensor. wavelength: of the light,
    micrometres."""
    slope_norm = math.sqrt(1.0 + slope * slope)
    dx, dy, dz = -slope / slope_norm, 0.0, 1.0 / slope_norm
    px, py, pz = x, y, 0.0
    count = curvature.shape[0]
    max_stray, weight, passages = 0.0, 1.0, 0
    surface, direction, reflections = 0, 1, 0
    while surface < count:
        c, z0 = curvature[surface], vertices[surface]
        # The ray meets the sphere (or plane, c = 0) at distance t: a t^2 - 2 b t + k = 0, the root nearest the vertex.
        oz = pz - z0
        a = c
        b = dz - c * (px * dx + py * dy + oz * dz)
        k = c * (px * px + py * py + oz * oz) - 2.0 * oz
        discriminant = b * b - a * k
        if discriminant < 0.0:
            return False
        root = math.sqrt(discriminant)
        distance = k / (b + math.copysign(root, b))
        px += distance * dx
        py += distance * dy
        pz += distance * dz
        radius = math.sqrt(px * px + py * py)
        if surface == stop:
            if passages < 3:
                out[STOP_X + 2 * passages] = px
                out[STOP_Y + 2 * passages] = py
                passages += 1
            surface += direction
            continue
        max_stray = max(max_stray, radius / semi_aperture[surface])
        index_before = index[surface - 1] if surface > 0 else 1.0
        index_after = index[surface]
        n0, n2 = (index_before, index_after) if direction > 0 else (index_after, index_before)
        # The surface's normal, on the side to which the ray travels.
        nx, ny, nz = -c * px, -c * py, 1.0 - c * (pz - z0)
        cosine = nx * dx + ny * dy + nz * dz
        if cosine < 0.0:
            nx, ny, nz, cosine = -nx, -ny, -nz, -cosine
        cosine = min(cosine, 1.0)
        reflected = reflectance(cosine, n0, n2, wavelength, coating[surface])
        if (reflections == 0 and surface == second) or (reflections == 1 and surface == first):
            weight *= reflected
            dx -= 2.0 * cosine * nx
            dy -= 2.0 * cosine * ny
            dz -= 2.0 * cosine * nz
            direction = -direction
            reflections += 1
        else:
            if reflected >= 1.0:
                return False
            weight *= 1.0 - reflected
            ratio = n0 / n2
            normal_factor = math.sqrt(1.0 - ratio * ratio * (1.0 - cosine * cosine)) - ratio * cosine
            dx = ratio * dx + normal_factor * nx
            dy = ratio * dy + normal_factor * ny
            dz = ratio * dz + normal_factor * nz
        surface += direction
    distance = (sensor - pz) / dz
    out[SENSOR_X] = px + distance * dx
    out[SENSOR_Y] = py + distance * dy
    out[STRAY] = max_stray
    out[WEIGHT] = weight
    for passage in range(passages, 3):
        out[STOP_X + 2 * passage] = out[STOP_X]
        out[STOP_Y + 2 * passage] = out[STOP_Y]
    return True


@compile_cached
def trace_grid(xs: Array, ys: Array, slope: float, first: int, second: int, curvature: Array, vertices: Array,
               index: Array, semi_aperture: Array, coating: Array, stop: int, sensor: float,
               wavelength: float) -> tuple[Array, NDArray[np.bool_]]:
    """Trace a ray through each point of the grid xs x ys on the plane z = 0.

    Returns the rays (rows, columns, FIELDS), and which (rows, columns) reach the sensor. The other arguments are those
    of `trace_ray`.
    """
    rays = np.zeros((ys.shape[0], xs.shape[0], FIELDS))
    arrived = np.zeros((ys.shape[0], xs.shape[0]), np.bool_)
    for row in range(ys.shape[0]):
        for column in range(xs.shape[0]):
            arrived[row, column] = trace_ray(xs[column], ys[row], slope, first, second, curvature, vertices,
                                             index, semi_aperture, coating, stop, sensor, wavelength,
                                             rays[row, column])
    return rays, arrived
