# SPDX-License-Identifier: GPL-3.0-or-later
"""The visibility of a light behind the scene (ours; docs/decisions/visibility.md).

A small camera at the view's position looks straight at the light, in the frame or not, and rasterizes the scene
Gaussians before it; the transmittance left over a soft disk is the visibility. It is differentiable by the scene's
Gaussians, and fades as a light with a size fades.

A fitted scene hides every light a little: Gaussians that show the lamp, or a sky without depth, stand before it. So
visibilities are relative to those of the training views that see most of the light (`FlareModel.clear`).
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..choices import Kernels
from ..gaussians import rasterization
from ..gaussians.scene import SceneGaussians
from ..look import PlacedLight
from ..look.shot import LIGHT_MARGIN, LIGHT_RADIUS
from .model import FlareModel

MIN_CLEAR = 0.01
"""Clear visibility below which a scene says nothing about a light."""
CLEAR_QUANTILE = 0.9
"""Quantile of the views' visibilities that counts as clear: a light may be hidden in most of them."""
MIN_RADIUS, MAX_RADIUS = 1e-4, 0.5
"""Range of the radius of a cell of an extent, relative to its distance."""
OCCLUSION_WEIGHT, MIN_VISIBILITY = 1e-4, 1e-6
"""Weight of the loss of a hidden light, about that of the pixels that show it; and what is added to its visibility."""


@dataclass(frozen=True)
class VisibilitySettings:
    """radius: standard deviation of the light's soft disk, relative to its distance. margin: Gaussians nearer to the
    light than this part of its distance do not hide it, since they show the lamp itself. pixels: side of the small
    picture."""

    radius: float = LIGHT_RADIUS
    margin: float = LIGHT_MARGIN
    pixels: int = 9


def light_visibilities(scene: SceneGaussians, model: FlareModel, world_to_camera: Tensor, settings: VisibilitySettings,
                       kernels: Kernels = "auto", frame: str = "") -> dict[str, Tensor]:
    """Return the visibility of each light from a pose (4, 4), by the light's name, relative to `FlareModel.clear`.

    frame: name of the frame, for lights that move.
    """
    pose = world_to_camera.double()
    camera = -pose[:3, :3].T @ pose[:3, 3]
    visibilities = _visibilities(scene, camera, list(model.positions_in(frame)), settings, kernels)
    return {name: relative_to_clear(visibility, clear)
            for name, visibility, clear in zip(model.names, visibilities, model.clear, strict=True)}


def relative_to_clear(visibility: Tensor, clear: Tensor | float) -> Tensor:
    """Return a visibility divided by `clear`, at most 1; 1 if `clear` is 0, which stands for unknown.

    clear: visibility of the light behind the scene where nothing hides it.
    """
    return (visibility / clear).clamp(max=1) if clear > 0 else visibility.new_ones(())


@torch.no_grad()
def visibility_from(scene: SceneGaussians, eye: NDArray[np.float64], light: NDArray[np.float64],
                    settings: VisibilitySettings, clear: float = 1.0) -> float:
    """Return the visibility, 0..1, of a light at `light` (3,) from a camera at `eye` (3,), world units.

    It is relative to `clear`, the light's visibility where nothing hides it; 1 for a scene other than that of the fit.
    """
    visibility = light_visibility(scene, torch.from_numpy(eye), torch.from_numpy(light), settings)
    return float(relative_to_clear(visibility, clear))


def visibility_behind(scene: SceneGaussians, world_to_camera: NDArray[np.float64], light: PlacedLight,
                      settings: VisibilitySettings, clear: float = 1.0) -> tuple[float, tuple[float, ...] | None]:
    """Return the visibility of a placed light behind a scene, 0..1, and the visible shares of the cells of its extent.

    A light without extent is a point: its shares are returned unchanged, None unless given. For an extent, the
    visibility is 1, and each share is the light's own times the visibility of a disk of the cell's size behind the
    scene. world_to_camera: (4, 4). clear: the light's visibility where nothing hides it.
    """
    pose = np.asarray(world_to_camera, np.float64)
    eye = -pose[:3, :3].T @ pose[:3, 3]
    if light.extent is None:
        return visibility_from(scene, eye, light.xyz, settings, clear), light.shares
    sampled = light.extent.sampled(light.xyz, pose)
    shares = []
    for cell, centre in enumerate(sampled.centres):
        share = 1.0 if light.shares is None else light.shares[cell]
        if share > 0:
            offsets = np.linalg.norm(sampled.points[sampled.cells == cell] - centre, axis=1)
            distance = max(float(np.linalg.norm(centre - eye)), 1e-9)
            # The standard deviation of the cell's points along one axis across the line of sight.
            radius = min(max(float(np.sqrt((offsets**2).mean() / 2)) / distance, MIN_RADIUS), MAX_RADIUS)
            share *= visibility_from(scene, eye, centre, replace(settings, radius=radius), clear)
        shares.append(share)
    return 1.0, tuple(shares)


@torch.no_grad()
def clear_visibilities(scene: SceneGaussians, model: FlareModel, poses: Sequence[Tensor], settings: VisibilitySettings,
                       kernels: Kernels = "auto", frames: Sequence[str] = ()) -> Tensor:
    """Return (lights,), the visibility of each light where nothing hides it: the 90 % quantile over these poses (4, 4).

    A quantile below MIN_CLEAR becomes 0, for unknown: the scene hides the light from everywhere, for example if the
    light lies inside an object. frames: name of each pose's frame, needed if lights move.
    """
    eyes = [-pose[:3, :3].double().T @ pose[:3, 3].double() for pose in poses]
    places = [model.positions_in(frame) for frame in frames or [""] * len(poses)]
    quantiles = []
    for number in range(len(model.names)):
        visibilities = torch.stack([
            light_visibility(scene, eye, lights[number], settings, kernels)
            for eye, lights in zip(eyes, places, strict=True)])
        quantiles.append(visibilities.quantile(CLEAR_QUANTILE))
    clear = torch.stack(quantiles).clamp(max=1)
    return clear.masked_fill(clear < MIN_CLEAR, 0)


def occlusion_loss(scene: SceneGaussians, eye: Tensor, lights: Sequence[Tensor], settings: VisibilitySettings,
                   kernels: Kernels = "auto") -> Tensor | None:
    """Return the loss of a scene that hides lights (3,), which the frame of the camera at `eye` (3,) shows.

    Its gradient makes Gaussians in front of the lights more transparent, such as a sky at a wrong distance. It is the
    negative logarithm of the visibilities: behind many layers, the visibility itself hardly changes with a single
    layer. None without lights.
    """
    visibilities = [light_visibility(scene, eye, light, settings, kernels) for light in lights]
    return -OCCLUSION_WEIGHT * (torch.stack(visibilities) + MIN_VISIBILITY).log().sum() if visibilities else None


def light_visibility(scene: SceneGaussians, eye: Tensor, light: Tensor, settings: VisibilitySettings | None = None,
                     kernels: Kernels = "auto") -> Tensor:
    """Return the visibility (scalar, 0..1) of a light at `light` (3,) from a camera at `eye` (3,); world units.

    A small camera that looks from the eye at the light rasterizes the Gaussians in between; the visibility is the mean
    transmittance over a Gaussian window, the light's soft disk.
    """
    return _visibilities(scene, eye, [light], settings or VisibilitySettings(), kernels)[0]


class _Occluders(NamedTuple):
    """Gaussians that may hide a light, with the parameters of `SceneGaussians`."""

    means: Tensor
    quaternions: Tensor
    log_scales: Tensor
    opacity_logits: Tensor

    def select(self, rows: Tensor) -> _Occluders:
        """Return the Gaussians at these rows."""
        return _Occluders(*(part[rows] for part in self))


class _SightLine(NamedTuple):
    """The line of sight to a light.

    pose: (4, 4), world to camera, of a small camera that looks along it. distance: of the light, world units. rows: of
    the scene's Gaussians that may hide the light.
    """

    pose: Tensor
    distance: float
    rows: Tensor


def _visibilities(scene: SceneGaussians, eye: Tensor, lights: Sequence[Tensor], settings: VisibilitySettings,
                  kernels: Kernels) -> list[Tensor]:
    """Return the `light_visibility` of each light (3,) from a camera at `eye` (3,).

    The Gaussians that may hide any of the lights are selected together: the gradient of each selection has the size of
    the whole scene.
    """
    sight_lines = [_sight_line(scene, eye, light, settings) for light in lights]
    clear = scene.means.new_ones(())
    all_rows = [sight_line.rows for sight_line in sight_lines if sight_line is not None]
    if not all_rows:
        return [clear for _ in lights]
    rows = torch.unique(torch.cat(all_rows)) if len(all_rows) > 1 else all_rows[0]
    occluders = _Occluders(scene.means, scene.quaternions, scene.log_scales, scene.opacity_logits).select(rows)
    visibilities = []
    for sight_line in sight_lines:
        if sight_line is None:
            visibilities.append(clear)
            continue
        is_subset = len(sight_line.rows) < len(rows)
        light_occluders = occluders.select(torch.searchsorted(rows, sight_line.rows)) if is_subset else occluders
        near = _near_plane(scene, sight_line.distance)
        visibilities.append(_mean_transmittance(light_occluders, sight_line.pose, near, settings, kernels))
    return visibilities


def _sight_line(scene: SceneGaussians, eye: Tensor, light: Tensor, settings: VisibilitySettings) -> _SightLine | None:
    """Return the line of sight from `eye` (3,) to a light (3,); None for a light at the eye, which nothing hides."""
    direction = (light - eye).float()
    distance = float(direction.norm())
    if distance <= 0:
        return None
    pose = _look_along(eye.float(), direction / distance)
    return _SightLine(pose, distance, _occluder_rows(scene, pose, distance, settings))


def _mean_transmittance(occluders: _Occluders, pose: Tensor, near: float, settings: VisibilitySettings,
                        kernels: Kernels) -> Tensor:
    """Return the mean transmittance (scalar, 0..1) of Gaussians over a light's soft disk.

    pose: (4, 4), world to camera, of the small camera that looks at the light. near: its near plane, world units.
    """
    size, half = settings.pixels, settings.pixels / 2
    # The picture's edge is at twice the disk's radius, which is the window's standard deviation.
    focal = half / (2 * settings.radius)
    intrinsics = torch.tensor([[focal, 0, half], [0, focal, half], [0, 0, 1]])
    # Colours are not needed, and their gradient would cost most.
    colourless = occluders.means.new_zeros(len(occluders.means), 1, 3)
    alpha = rasterization(occluders.means, occluders.quaternions, occluders.log_scales.exp(),
                          occluders.opacity_logits.sigmoid(), colourless, pose.to(colourless),
                          intrinsics.to(colourless), size, size, near=near, depth=False, kernels=kernels).alpha
    offset = torch.arange(size, device=alpha.device) + 0.5 - half
    window = torch.exp(-0.5 * (offset / (half / 2)) ** 2)
    weights = window[:, None] * window
    return ((1 - alpha) * weights).sum() / weights.sum()


def _near_plane(scene: SceneGaussians, distance: float) -> float:
    """Return the smallest depth at which Gaussians hide a light at this distance, world units: at most the scene's near
    plane, so that everything a picture shows can hide a light."""
    return min(1e-3 * distance, scene.near)


def _occluder_rows(scene: SceneGaussians, pose: Tensor, distance: float, settings: VisibilitySettings) -> Tensor:
    """Return the rows of Gaussians between camera and light that may touch the small picture, without the far layer.

    pose: world_to_camera (4, 4) of the small camera. distance: from camera to light. On the CPU it uses numpy, which
    takes a third of torch's time here.
    """
    if not scene.means.is_cpu:
        return _occluder_rows_on_device(scene, pose.to(scene.means), distance, settings)
    means, scales, camera_pose = (part.detach().numpy() for part in (scene.means, scene.log_scales, pose))
    # Sums of columns, since a product of matrices this narrow waits for the threads of the BLAS.
    x, y, depth = (sum(means[:, axis] * row[axis] for axis in range(3)) + row[3] for row in camera_pose[:3])
    reach = 3 * np.exp(np.maximum(np.maximum(scales[:, 0], scales[:, 1]), scales[:, 2]))
    between = (depth > _near_plane(scene, distance)) & (depth < (1 - settings.margin) * distance)
    if scene.far is not None:
        between &= ~scene.far.contains(scene.means).numpy()
    off_axis = np.sqrt(x * x + y * y)
    # The picture's corners are at 2 sqrt(2) radii from its middle.
    return torch.from_numpy(np.flatnonzero(between & (off_axis < depth * settings.radius * 4 + reach)))


@torch.no_grad()
def _occluder_rows_on_device(scene: SceneGaussians, pose: Tensor, distance: float,
                             settings: VisibilitySettings) -> Tensor:
    """Return the rows of `_occluder_rows` for a scene on a GPU, computed there. pose: (4, 4), on the scene's device."""
    x, y, depth = (scene.means @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    reach = 3 * scene.log_scales.amax(-1).exp()
    between = (depth > _near_plane(scene, distance)) & (depth < (1 - settings.margin) * distance)
    if scene.far is not None:
        between &= ~scene.far.contains(scene.means)
    return torch.nonzero(between & (torch.hypot(x, y) < depth * settings.radius * 4 + reach))[:, 0]


def _look_along(position: Tensor, forward: Tensor) -> Tensor:
    """Return world_to_camera (4, 4) of a camera that looks along the unit vector `forward`, with any roll."""
    helper = torch.eye(3)[int(forward.abs().argmin())]
    right = torch.linalg.cross(helper, forward)
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ position
    return pose
