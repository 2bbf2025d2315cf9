# SPDX-License-Identifier: GPL-3.0-or-later
"""Aligns the world of a solve, which structure from motion leaves open: up is +z, the floor is near z = 0, and the
scene is some 5 units away, so that it opens upright and within reach in Blender.

Photographers turn cameras far more than they roll them: the cameras' x axes lie in the horizon. Up is the direction
most nearly perpendicular to all of them that also agrees with the frames' up.
"""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..camera import Floats
from .mapping import Model

MEDIAN_DISTANCE = 5.0
"""Median distance of a point from the cameras that see it, after alignment."""


def up_direction(rotations: Sequence[Floats]) -> Floats:
    """Return the unit up vector (3,) of the world, from world-to-camera rotations (3, 3).

    The unit vector u minimises sum (x_i . u)^2 - n/5 (y . u)^2 over n cameras, with x_i their x axes and y the mean of
    their up axes: where all cameras look one way, the x axes alone leave u undecided.
    """
    stack = np.asarray(rotations)
    right, mean_up = stack[:, 0], -stack[:, 1].mean(axis=0)
    form = right.T @ right / len(stack) - 0.2 * np.outer(mean_up, mean_up)
    up = np.linalg.eigh(form)[1][:, 0]
    return up if up @ mean_up >= 0 else -up


def align(model: Model) -> None:
    """Rotate, scale and shift the model in place: +z is up, and the cameras' mean heading is +y.

    The points' median is then at x = y = 0. Their lowest 2 % are below z = 0: outliers below the floor.
    """
    up = up_direction([frame.world_to_camera[:3, :3] for frame in model.frames])
    heading = np.mean([frame.world_to_camera[2, :3] for frame in model.frames], axis=0)
    heading = heading - (heading @ up) * up
    if np.linalg.norm(heading) < 1e-3:  # the views cancel out: any heading will do
        heading = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    heading /= np.linalg.norm(heading)
    to_world = np.stack([np.cross(heading, up), heading, up])  # Blender's front view: x right, y ahead, z up
    scale = MEDIAN_DISTANCE / _median_distance(model)
    xyz = scale * model.xyz @ to_world.T
    shift = -np.array([*np.median(xyz[:, :2], axis=0), np.percentile(xyz[:, 2], 2)])
    model.xyz = xyz + shift
    for frame in model.frames:
        rotation = frame.world_to_camera[:3, :3] @ to_world.T
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = scale * frame.world_to_camera[:3, 3] - rotation @ shift
        frame.world_to_camera = pose


def _median_distance(model: Model) -> float:
    """Return the median distance of points from the cameras that see them."""
    distances = []
    for frame in model.frames:
        local = model.xyz[frame.points] @ frame.world_to_camera[:3, :3].T + frame.world_to_camera[:3, 3]
        distances.append(np.linalg.norm(local, axis=1))
    return float(np.median(np.concatenate(distances)))
