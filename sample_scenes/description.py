# SPDX-License-Identifier: GPL-3.0-or-later
"""Describes a sample capture: camera path, lights, lens, brightness. It needs no Blender.

World axes are Blender's (z up); cameras are OpenCV's and COLMAP's (x right, y down, z forward). Lengths are scene
units.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pinhole:
    """A camera without distortion; pixel centres at +0.5."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def scaled(self, width: int, height: int) -> Pinhole:
        """Return the same camera with another number of pixels; the aspect may change."""
        x, y = width / self.width, height / self.height
        return Pinhole(width, height, self.fx * x, self.fy * y, self.cx * x, self.cy * y)


@dataclass(frozen=True)
class LightSource:
    """A small bright sphere in the scene, and the strength of the flare that it causes.

    colour: linear RGB, about 1 at its largest. radius: of the sphere, scene units. emission: its radiance to a camera,
    linear. power: of the lamp that lights the scene, watts (a sun: W/m^2). flare: strength of its flare at
    `reference_distance` units from the camera; it falls with the square of the distance, as light does, unless
    `distant` (a sun).
    """

    name: str
    xyz: tuple[float, float, float]
    colour: tuple[float, float, float]
    radius: float
    emission: float
    power: float
    flare: float
    reference_distance: float = 5.0
    distant: bool = False

    def flare_strength(self, distance: float) -> float:
        """Return the strength of the flare at `distance` units."""
        return self.flare if self.distant else self.flare * (self.reference_distance / distance) ** 2


@dataclass(frozen=True)
class SceneDescription:
    """Everything about a capture but its geometry, which `build` makes inside Blender."""

    name: str
    seed: int
    first_number: int
    views: int
    camera: Pinhole
    camera_path: Callable[[Array], Array]
    """world_to_camera (n, 4, 4) for the numbers of n views."""
    build: Callable[[SceneDescription], None]
    lights: tuple[LightSource, ...]
    lens: str
    """Name of a setup in `flares.LENS_SETUPS`."""
    samples: int = 40
    held_out: tuple[int, ...] = field(default=())
    """Numbers of views that are held out besides every eighth."""
    step: int = 1
    """Difference of the numbers of two successive views."""

    @property
    def numbers(self) -> NDArray[np.int64]:
        """The views' numbers on the path; a file is called after its view's."""
        return self.first_number + self.step * np.arange(self.views)

    def resampled(self, width: int | None, every: int) -> SceneDescription:
        """Return the capture with pictures of another width, px, and only every so many of its views.

        None keeps the width. A wider picture gets fewer samples per pixel, 8 at least, since it shows the same noise
        smaller.
        """
        camera = self.camera
        ratio = 1.0 if width is None else width / camera.width
        return replace(self, camera=camera.scaled(round(camera.width * ratio), round(camera.height * ratio)),
                       samples=max(min(self.samples, 8), round(self.samples / max(ratio, 1))),
                       views=-(-self.views // every), step=self.step * every)

    @property
    def stems(self) -> list[str]:
        """File names of the views without suffix: 0006, 0007, …"""
        return [f"{number:04d}" for number in self.numbers]

    @property
    def poses(self) -> Array:
        """world_to_camera (views, 4, 4)."""
        return self.camera_path(self.numbers.astype(float))


def look_at(eye: Array, target: Array, roll: float = 0.0) -> Array:
    """Return world_to_camera (4, 4) of a camera at `eye` that looks at `target`, z up, rolled by `roll` radians."""
    forward = target - eye
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    cosine, sine = np.cos(roll), np.sin(roll)
    rotation = np.stack([cosine * right + sine * down, cosine * down - sine * right, forward])
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ eye
    return pose


def camera_positions(world_to_camera: Array) -> Array:
    """Return the centres (n, 3) of cameras (n, 4, 4)."""
    return -np.einsum("nij,ni->nj", world_to_camera[:, :3, :3], world_to_camera[:, :3, 3])


def disc_points(centre: Array, eye: Array, radius: float, count: int, up: tuple[float, float, float]) -> Array:
    """Return points (count, 3), spread evenly over a disc that faces `eye`: a sunflower spiral.

    Each point is turned by the golden angle from the one before. up: a direction that the line of sight is not parallel
    to.
    """
    axis = (centre - eye) / np.linalg.norm(centre - eye)
    side = np.cross(axis, up)
    side /= np.linalg.norm(side)
    index = np.arange(count) + 0.5
    distance, angle = radius * np.sqrt(index / count), index * np.pi * (3 - np.sqrt(5))
    return np.asarray(centre + distance[:, None] * (np.cos(angle)[:, None] * side
                                                    + np.sin(angle)[:, None] * np.cross(side, axis)))
