# SPDX-License-Identifier: GPL-3.0-or-later
"""Refines the place of a light on its detections: robust Gauss-Newton on direction and inverse distance.

The origin is the mean position of the cameras that see the light (Civera et al. 2008), so that the sun is no special
case: its inverse distance is zero within its uncertainty.
"""
from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..capture.camera import Floats
from .observations import Observations

MAX_STEPS = 20
MAX_ROUNDS = 5
"""Rounds of refinement and new choice of inliers."""
HUBER = 1.5
"""Residual, in standard deviations, from which Huber's weight falls."""
PRIOR = 0.01
"""Weight of the pull towards infinity: the inverse distance is 0 with a standard deviation of 1 / (PRIOR extent)."""


class InverseDistance(NamedTuple):
    """A place as a unit direction (3,) from an origin (3,) and the inverse of its distance, 0 at infinity."""

    origin: Floats
    direction: Floats
    inverse: float


def parametrise(observations: Observations, place: Floats, inliers: NDArray[np.int64]) -> InverseDistance:
    """Return a place (4,) relative to the mean position of the cameras of its inliers."""
    origin = observations.position[observations.view[inliers]].mean(axis=0)
    offset = place[:3] - place[3] * origin
    length = float(np.linalg.norm(offset))
    return InverseDistance(origin, offset / length, float(place[3] / length))


def refine_until_stable(observations: Observations, place: Floats, remaining: NDArray[np.bool_],
                        extent: float) -> tuple[Floats, NDArray[np.int64], Floats]:
    """Refine a place (4,) and choose its inliers in turn, until they no longer change.

    remaining: (d,), true for detections that may be inliers. extent: size of the cameras' path, world units. Returns
    the place, the indices of its inliers, and the covariance (3, 3) of direction (two angles) and inverse distance.
    """
    inliers = observations.inliers(place, remaining)
    covariance = np.full((3, 3), np.inf)
    for _ in range(MAX_ROUNDS):
        if len(inliers) < 2:
            break
        place, covariance = _refine(observations, place, inliers, extent)
        new_inliers = observations.inliers(place, remaining)
        if np.array_equal(new_inliers, inliers):
            break
        inliers = new_inliers
    return place, inliers, covariance


def _refine(observations: Observations, place: Floats, inliers: NDArray[np.int64],
            extent: float) -> tuple[Floats, Floats]:
    """Run Gauss-Newton with Huber weights; returns the place (4,) and its covariance (3, 3).

    inliers: indices (n,) of the detections to fit. extent: size of the cameras' path, world units. The covariance is
    that of two angles of the direction, radians, and of the inverse distance.
    """
    origin, direction, inverse = parametrise(observations, place, inliers)
    # Standard deviation of each detection, pixels: a third of its tolerance, more for a low score.
    sigma = (np.maximum(observations.tolerance[inliers] / 3, 0.5)
             / np.sqrt(np.maximum(observations.weight[inliers], 0.05)))
    basis = _tangent_basis(direction)
    information = np.eye(3)
    for _ in range(MAX_STEPS):
        residual, jacobian = _residuals(observations, inliers, InverseDistance(origin, direction, inverse), basis)
        size = np.linalg.norm(residual, axis=1) / sigma
        weight = np.where(size < HUBER, 1.0, HUBER / np.maximum(size, 1e-9)) / sigma ** 2
        information = np.einsum("nij,nik,n->jk", jacobian, jacobian, weight)
        # A weak pull towards infinity keeps the distance defined where the views do not determine it.
        information[2, 2] += (PRIOR * extent) ** 2
        gradient = np.einsum("nij,ni,n->j", jacobian, residual, weight)
        gradient[2] += (PRIOR * extent) ** 2 * inverse
        step = np.linalg.solve(information + 1e-12 * np.trace(information) * np.eye(3), -gradient)
        # The projection is far from linear in the inverse distance, so its step is limited.
        step[2] = np.clip(step[2], -0.5 * abs(inverse) - 0.05 / extent, 0.5 * abs(inverse) + 0.05 / extent)
        direction = direction + basis @ step[:2]
        direction /= np.linalg.norm(direction)
        basis = _tangent_basis(direction)
        inverse = max(inverse + step[2], 0.0)
        if np.abs(step * (1, 1, extent)).max() < 1e-9:
            break
    residual, _ = _residuals(observations, inliers, InverseDistance(origin, direction, inverse), basis)
    # Scaled by the mean squared residual, at least 0.1: two or three detections always fit almost exactly.
    variance = max(float(np.mean((residual / sigma[:, None]) ** 2)), 0.1)
    covariance = np.linalg.inv(information) * variance
    return np.array([*(direction + inverse * origin), inverse]), covariance


def _residuals(observations: Observations, inliers: NDArray[np.int64], place: InverseDistance,
               basis: Floats) -> tuple[Floats, Floats]:
    """Return residuals (n, 2), projection minus detection in pixels, and their derivatives (n, 2, 3) by two angles and
    the inverse distance.

    inliers: indices (n,) of the detections. basis: (3, 2), two unit vectors perpendicular to the place's direction,
    along which the angles are measured.
    """
    view = observations.view[inliers]
    rotation, shift = observations.rotation[view], place.origin - observations.position[view]
    local = np.einsum("nij,nj->ni", rotation, place.direction + place.inverse * shift)
    depth = np.maximum(local[:, 2], 1e-9)
    residual = (local[:, :2] / depth[:, None] * observations.focal[view] + observations.centre[view]
                - observations.pixel[inliers])
    pixel_by_local = np.zeros((len(view), 2, 3))
    pixel_by_local[:, 0, 0], pixel_by_local[:, 1, 1] = 1 / depth, 1 / depth
    pixel_by_local[:, :, 2] = -local[:, :2] / depth[:, None] ** 2
    pixel_by_local *= observations.focal[view][:, :, None]
    local_by_state = np.concatenate([rotation @ basis, np.einsum("nij,nj->ni", rotation, shift)[:, :, None]], axis=2)
    return residual, pixel_by_local @ local_by_state


def _tangent_basis(direction: Floats) -> Floats:
    """Return (3, 2), two unit vectors perpendicular to a direction and to each other."""
    first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)], axis=1)
