# SPDX-License-Identifier: GPL-3.0-or-later
"""Casts rays at textured rectangles by numpy: the scenes of the sample shots, which need no Blender.

World axes are those of a camera: x right, y down, z forward. Surfaces are matt; lamps light them without shadows, by
the cosine and the square of the distance. Pictures are scene-linear and averaged over 2 x 2 rays per pixel.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .description import Array, Pinhole, disc_points

Pixels = NDArray[np.float32]

RAYS_PER_SIDE = 2
"""Rays along each side of a pixel."""
SHARE_SAMPLES = 128
"""Points on a lamp's disc whose visibility is tested."""
MAX_REMAP_ROWS = 32000
"""Rows of a map that `cv2.remap` gets at once; it takes fewer than 32768."""


@dataclass(frozen=True, eq=False)
class Quad:
    """A rectangle: corner (3,), edges u and v (3,), perpendicular; texture (h, w, 3), linear reflectance.

    radiance: 0 for a surface that reflects; otherwise it emits its texture times this factor and reflects nothing.
    """

    corner: Array
    u: Array
    v: Array
    texture: Pixels
    radiance: float = 0.0

    def moved(self, offset: Array) -> Quad:
        """Return the rectangle, moved."""
        return Quad(self.corner + offset, self.u, self.v, self.texture, self.radiance)


@dataclass(frozen=True, eq=False)
class Lamp:
    """A bright sphere: xyz (3,), radius, colour (3,) linear, radiance of its disc, power by which it lights surfaces.

    beam: (3,) the direction into which a headlight shines, or None for all.
    """

    xyz: Array
    radius: float
    colour: Array
    radiance: float
    power: float
    beam: Array | None = None


def quad(corner: Sequence[float], u: Sequence[float], v: Sequence[float], texture: Pixels, radiance: float = 0.0
         ) -> Quad:
    """Make a rectangle from plain numbers."""
    return Quad(np.array(corner, float), np.array(u, float), np.array(v, float), texture, radiance)


def box_sides(low: Sequence[float], high: Sequence[float], texture: Pixels) -> list[Quad]:
    """Return five sides of a box between the corners `low` and `high`: all but the bottom, which no camera sees.

    y grows downwards, so the bottom is at the y of `high`.
    """
    (x0, y0, z0), (x1, y1, z1) = low, high
    return [quad((x0, y0, z0), (x1 - x0, 0, 0), (0, y1 - y0, 0), texture),
            quad((x0, y0, z1), (x1 - x0, 0, 0), (0, y1 - y0, 0), texture),
            quad((x0, y0, z0), (0, 0, z1 - z0), (0, y1 - y0, 0), texture),
            quad((x1, y0, z0), (0, 0, z1 - z0), (0, y1 - y0, 0), texture),
            quad((x0, y0, z0), (x1 - x0, 0, 0), (0, 0, z1 - z0), texture)]


@dataclass(frozen=True, eq=False)
class Hits:
    """The nearest surface of each ray: distance (n,) along it, albedo (n, 3), emission (n, 3), normal (n, 3)."""

    distance: NDArray[np.float32]
    albedo: Pixels
    emission: Pixels
    normal: Pixels

    def nearer(self, other: Hits) -> Hits:
        """Return the nearer of two hits of the same rays."""
        closer = (self.distance <= other.distance)[:, None]
        return Hits(np.minimum(self.distance, other.distance), np.where(closer, self.albedo, other.albedo),
                    np.where(closer, self.emission, other.emission), np.where(closer, self.normal, other.normal))


def camera_rays(camera: Pinhole, rotation: Array) -> Pixels:
    """Return the unit directions (n, 3), in world axes, of RAYS_PER_SIDE x RAYS_PER_SIDE rays per pixel, row by row.

    rotation: (3, 3) world to camera.
    """
    width, height = camera.width * RAYS_PER_SIDE, camera.height * RAYS_PER_SIDE
    x, y = np.meshgrid(((np.arange(width) + 0.5) / RAYS_PER_SIDE - camera.cx) / camera.fx,
                       ((np.arange(height) + 0.5) / RAYS_PER_SIDE - camera.cy) / camera.fy)
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) @ rotation
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True), np.float32)


def cast_rays(quads: Sequence[Quad], eye: Array, rays: Pixels) -> Hits:
    """Return the nearest hits of unit rays (n, 3) from `eye`.

    Where nothing is hit, the distance is infinite, and albedo, emission and normal are 0. Normals face the eye.
    """
    count = len(rays)
    hits = Hits(np.full(count, np.inf, np.float32), *(np.zeros((count, 3), np.float32) for _ in range(3)))
    for rectangle in quads:
        distance, u, v = _intersect(rectangle, eye, rays)
        index = np.flatnonzero((distance < hits.distance) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1))
        if not len(index):
            continue
        height, width = rectangle.texture.shape[:2]
        columns, rows = u[index] * (width - 1), v[index] * (height - 1)
        colour = _sample_texture(rectangle.texture, columns, rows)
        normal = np.cross(rectangle.u, rectangle.v)
        # Towards the eye; the sign is 0 for an eye in the plane.
        normal = normal / np.linalg.norm(normal) * (-np.sign(normal @ (rectangle.corner - eye)) or 1.0)
        hits.distance[index] = distance[index]
        hits.albedo[index] = 0.0 if rectangle.radiance else colour
        hits.emission[index] = colour * np.float32(rectangle.radiance)
        hits.normal[index] = normal
    return hits


def _sample_texture(texture: Pixels, columns: Pixels, rows: Pixels) -> Pixels:
    """Sample a texture bilinearly at (n,) columns and rows, in parts that OpenCV accepts; return (n, 3)."""
    parts = []
    for start in range(0, len(columns), MAX_REMAP_ROWS):
        part = slice(start, start + MAX_REMAP_ROWS)
        colours = cv2.remap(texture, columns[part].reshape(-1, 1), rows[part].reshape(-1, 1), cv2.INTER_LINEAR)
        parts.append(colours.reshape(-1, 3))
    return np.concatenate(parts).astype(np.float32)


def _intersect(rectangle: Quad, eye: Array, rays: Pixels) -> tuple[Pixels, Pixels, Pixels]:
    """Return where rays meet the plane of a rectangle: distances along them, and coordinates along u and v, each (n,).

    The distance is infinite for rays parallel to the plane, and where they meet it behind the eye. Coordinates are 0..1
    inside the rectangle, and -1 where infinity times 0 leaves them undefined.
    """
    normal = np.cross(rectangle.u, rectangle.v)
    normal_component = rays @ normal.astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.float32((rectangle.corner - eye) @ normal) / normal_component
        distance = np.where(distance > 1e-4, distance, np.float32(np.inf))
        # The rays are projected onto the edges, so that no hit points have to be stored.
        coordinates = [
            distance * (rays @ (edge / (edge @ edge)).astype(np.float32))
            - np.float32((rectangle.corner - eye) @ edge / (edge @ edge)) for edge in (rectangle.u, rectangle.v)]
    return distance, np.nan_to_num(coordinates[0], nan=-1), np.nan_to_num(coordinates[1], nan=-1)


def shade(hits: Hits, eye: Array, rays: Pixels, lamps: Sequence[Lamp], ambient: Array) -> Pixels:
    """Return the radiance (n, 3) along rays: emission, and ambient and lamp light that the surface reflects.

    Where a lamp's disc is nearer than the surface, the ray has the lamp's radiance. hits: the surfaces that the rays
    meet. eye: origin of the rays, (3,). rays: unit directions, (n, 3). ambient: light (3,) that reaches every surface
    evenly.
    """
    has_hit = np.isfinite(hits.distance)
    points = eye.astype(np.float32) + np.where(has_hit, hits.distance, 0)[:, None] * rays
    light = np.broadcast_to(ambient.astype(np.float32), hits.albedo.shape).copy()
    for lamp in lamps:
        if not lamp.power:
            continue
        to_lamp = lamp.xyz.astype(np.float32) - points
        squared_distance = (to_lamp * to_lamp).sum(1) + np.float32(0.02)  # keeps the light finite close to the lamp
        distance = np.sqrt(squared_distance)
        cosine = np.maximum((to_lamp * hits.normal).sum(1) / distance, 0)
        strength = lamp.power * cosine / squared_distance
        if lamp.beam is not None:  # a headlight: the cube of the cosine to its beam
            strength *= np.maximum(-(to_lamp @ lamp.beam.astype(np.float32)) / distance, 0) ** 3
        light += strength[:, None] * lamp.colour.astype(np.float32)
    radiance = hits.emission + hits.albedo * light
    for lamp in lamps:
        if lamp.radiance:
            covered = _lamp_disc_mask(lamp, eye, rays, hits.distance)
            radiance[covered] = lamp.colour.astype(np.float32) * np.float32(lamp.radiance)
    return radiance


def _lamp_disc_mask(lamp: Lamp, eye: Array, rays: Pixels, distance: Pixels) -> NDArray[np.bool_]:
    """Return a mask (n,) of the rays that meet a lamp's sphere before the surfaces at these distances (n,)."""
    to_lamp = lamp.xyz - eye
    # Distance from the eye to the point of each ray that is nearest to the sphere's centre.
    centre_distance = rays @ to_lamp.astype(np.float32)
    # Squared distance from that point to the sphere's centre, by Pythagoras.
    squared_offset = np.float32(to_lamp @ to_lamp) - centre_distance * centre_distance
    is_nearer = centre_distance - lamp.radius < distance
    return np.asarray((centre_distance > 0) & (squared_offset < lamp.radius**2) & is_nearer)


def average_rays(radiance: Pixels, camera: Pinhole) -> Pixels:
    """Average the rays of each pixel, in the order of `camera_rays`: (n, 3) to (height, width, 3)."""
    side = RAYS_PER_SIDE
    grid = radiance.reshape(camera.height, side, camera.width, side, 3)
    return np.asarray(grid.mean((1, 3)), np.float32)


def visible_share(lamp: Lamp, eye: Array, quads: Sequence[Quad]) -> float:
    """Return the share of a lamp's disc that no rectangle hides from `eye`, 0..1."""
    points = disc_points(lamp.xyz, eye, lamp.radius, SHARE_SAMPLES, up=(0.0, 1.0, 0.0))
    distance = float(np.linalg.norm(lamp.xyz - eye))
    rays = np.asarray((points - eye) / np.linalg.norm(points - eye, axis=1, keepdims=True), np.float32)
    return float((cast_rays(quads, eye, rays).distance >= distance - lamp.radius).mean())
