# SPDX-License-Identifier: GPL-3.0-or-later
"""A pinhole camera with its pose: OpenCV axes (x right, y down, z forward), pixel centres at +0.5.

    u = fx x/z + cx,  v = fy y/z + cy,  (x, y, z, 1) = world_to_camera (X, Y, Z, 1)
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import CaptureError

Floats = NDArray[np.float64]
ASPECT_TOLERANCE = 0.02
"""Difference from 1 within which a pixel aspect ratio counts as 1."""
MAX_BLIND_SHARE = 0.5
"""Where a larger share of the cameras sees nothing of a scene, it is of another world."""
SAMPLED_POINTS = 10_000
"""Approximate number of points of a scene that are looked for on the frames before all of them are."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera: size in pixels, intrinsics in pixels, and `world_to_camera` (4, 4), a rigid motion.

    exposure: factor of the frame's light relative to the capture's median frame. frame: name of the frame, if it has
    lights or a plate of its own; else empty.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: Floats
    exposure: float = 1.0
    frame: str = ""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.width, self.height

    @property
    def numbers(self) -> tuple[Any, ...]:
        """All values as plain numbers, which change whenever the camera's picture would."""
        unusual = () if self.exposure == 1 else (self.exposure,)
        named = (self.frame,) if self.frame else ()
        return self.size, self.intrinsics.tolist(), self.world_to_camera.tolist(), *unusual, *named

    @property
    def intrinsics(self) -> Floats:
        """(3, 3) matrix from (x/z, y/z, 1) to pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def focal_length(self) -> float:
        """Focal length in pixels, the geometric mean of both directions."""
        return math.sqrt(self.fx * self.fy)

    @property
    def pixel_aspect(self) -> float:
        """Pixel aspect ratio (width / height), 2 for squeezed plates; 1 where a solve found slightly different focal
        lengths."""
        aspect = self.fy / self.fx
        return round(aspect, 3) if abs(aspect - 1) > ASPECT_TOLERANCE else 1.0

    @property
    def corner_radius(self) -> float:
        """Distance of the frame's farthest corner from the principal point, normalised coordinates."""
        return math.hypot(max(self.cx, self.width - self.cx) / self.fx, max(self.cy, self.height - self.cy) / self.fy)

    @property
    def camera_to_world(self) -> Floats:
        """(4, 4), the inverse of the pose."""
        inverse = np.eye(4)
        inverse[:3, :3] = self.world_to_camera[:3, :3].T
        inverse[:3, 3] = self.position
        return inverse

    @property
    def position(self) -> Floats:
        """(3,) centre of projection in world coordinates."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    @property
    def forward(self) -> Floats:
        """(3,) unit viewing direction in world coordinates."""
        return self.world_to_camera[2, :3].copy()

    def scaled(self, width: int, height: int | None = None) -> Camera:
        """Return the camera at another size in pixels; without a height the proportions stay."""
        height = height or max(round(self.height * width / self.width), 1)
        scale_x, scale_y = width / self.width, height / self.height
        return replace(self, width=width, height=height,
                       fx=self.fx * scale_x, cx=self.cx * scale_x, fy=self.fy * scale_y, cy=self.cy * scale_y)

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """Return the camera of the part of its picture with this corner and size, pixels."""
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top)

    def project_normalised(self, xyz: ArrayLike) -> tuple[Floats, Floats]:
        """Project world points (n, 3) to ((n, 2) of x/z and y/z, (n,) depth z).

        A point in the camera's plane (z = 0) has no image: its coordinates are not finite. The coordinates of a point
        behind the camera (z < 0) are mirrored: check the depth.
        """
        points = np.asarray(xyz, np.float64).reshape(-1, 3)
        local = points @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]
        depth = local[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            return local[:, :2] / depth[:, None], depth

    def project(self, xyz: ArrayLike) -> tuple[Floats, Floats]:
        """Project world points (n, 3) to (pixels (n, 2), depth (n,)).

        See `project_normalised` for points that are not in front.
        """
        plane, depth = self.project_normalised(xyz)
        return plane * (self.fx, self.fy) + (self.cx, self.cy), depth

    def jacobian(self, xyz: ArrayLike) -> Floats:
        """Return the derivative (2, 3) of the pixel of a world point (3,) by the point, which is in front of the
        camera."""
        rotation = self.world_to_camera[:3, :3]
        x, y, z = rotation @ np.asarray(xyz, np.float64) + self.world_to_camera[:3, 3]
        projection = np.array([[self.fx, 0, -self.fx * x / z], [0, self.fy, -self.fy * y / z]]) / z
        return np.asarray(projection @ rotation)

    def rays(self, pixels: ArrayLike) -> Floats:
        """Convert pixels (n, 2) to unit directions (n, 3) in world coordinates, from `position`."""
        plane = (np.asarray(pixels, np.float64).reshape(-1, 2) - (self.cx, self.cy)) / (self.fx, self.fy)
        local = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
        rays = local @ self.world_to_camera[:3, :3]
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def contains(self, pixels: ArrayLike, depth: Any = 1.0) -> NDArray[np.bool_]:
        """Return (n,), true for pixels (n, 2), with their depths (n,), in front of the camera and inside the frame."""
        points = np.asarray(pixels, np.float64).reshape(-1, 2)
        with np.errstate(invalid="ignore"):
            return np.asarray((np.asarray(depth) > 0) & (points >= 0).all(axis=1) & (points <= self.size).all(axis=1))


def triangulate_midpoints(origins: Floats, rays: Floats, other_origins: Floats, other_rays: Floats
                          ) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return midpoints (n, 3) of the shortest segments between two rays, and cosines (n,) of the angles of the rays.

    The third result (n,) is true where both ends of the segment lie on the rays, not behind their origins. Parallel
    rays have no midpoint: where a cosine is near 1 or -1, the other results mean nothing.

    origins, other_origins: (n, 3) or (3,), world units. rays, other_rays: unit directions (n, 3).
    """
    baseline = other_origins - origins
    cosines = (rays * other_rays).sum(axis=1)
    along_rays, along_other_rays = (baseline * rays).sum(axis=1), (baseline * other_rays).sum(axis=1)
    squared_sines = np.maximum(1 - cosines ** 2, 1e-12)
    distances = (along_rays - cosines * along_other_rays) / squared_sines
    other_distances = (cosines * along_rays - along_other_rays) / squared_sines
    midpoints = 0.5 * (origins + distances[:, None] * rays + other_origins + other_distances[:, None] * other_rays)
    return midpoints, cosines, (distances > 0) & (other_distances > 0)


def check_in_view(cameras: Sequence[Camera], points: Floats, scene: str, world: str, hint: str = "") -> None:
    """Raise CaptureError if most cameras have no point of a scene (n, 3) on their frames: it is of another world.

    scene, world: what the message calls the scene, and whose world it should be in. hint: on how to export it.
    """
    blind = 0
    # All points are looked for only if too few cameras see a sample of them.
    for some_points in (points[::max(len(points) // SAMPLED_POINTS, 1)], points):
        blind = sum(not camera.contains(*camera.project(some_points)).any() for camera in cameras)
        if blind <= MAX_BLIND_SHARE * len(cameras):
            return
    raise CaptureError(f"{scene} is of another world than {world}: {blind} of {len(cameras)} views have none of its "
                       f"{len(points)} Gaussians before them; export it in the world of the cameras{hint}.")


def is_rotation(matrix: Floats) -> bool:
    """Return whether (3, 3) is a rotation, within the rounding of files."""
    return bool(np.allclose(matrix.T @ matrix, np.eye(3), atol=2e-3) and np.linalg.det(matrix) > 0)


def rotation_from_quaternion(wxyz: ArrayLike) -> Floats:
    """Return the rotation (3, 3) of a quaternion (w, x, y, z), normalised first; Hamilton's convention, as in
    COLMAP."""
    w, x, y, z = np.asarray(wxyz, np.float64) / np.linalg.norm(wxyz)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])


def quaternion_from_rotation(rotation: ArrayLike) -> Floats:
    """Return the unit quaternion (w, x, y, z), w >= 0, of a rotation (3, 3).

    Bar-Itzhack's method (2000): the quaternion is the eigenvector of the largest eigenvalue of a symmetric 4 x 4
    matrix, for every rotation alike.
    """
    r = np.asarray(rotation, np.float64)
    k_matrix = np.array([
        [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
        [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
        [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
        [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1]],
    ])
    vector = np.linalg.eigh(k_matrix)[1][:, -1]
    return vector if vector[0] >= 0 else -vector
