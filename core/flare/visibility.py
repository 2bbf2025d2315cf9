# SPDX-License-Identifier: GPL-3.0-or-later
"""The visibility of a light behind the scene (ours; docs/decisions/visibility.md).

A small camera at the view's position looks straight at the light, in the frame or not, and rasterizes the scene
Gaussians before it; the transmittance left over a soft disk is the visibility. It is differentiable by the scene's
Gaussians, and fades as a light with a size fades. This is the definition. On the CPU,
`core.gaussians.cpu.transmittance` computes all lines of sight at once, without a rasterizer.

A fitted scene hides every light a little: Gaussians that show the lamp, or a sky without depth, stand before it. So
visibilities are relative to those of the training views that see most of the light (`FlareModel.clear`).
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..choices import Kernels
from ..gaussians import rasterization
from ..gaussians.kernels import fused_kernels
from ..gaussians.rendering import OCCLUDER_REACH
from ..gaussians.scene import SceneGaussians
from ..look import PlacedLight
from ..look.shot import LIGHT_MARGIN, LIGHT_RADIUS
from .model import FlareModel

MIN_CLEAR = 0.01
"""Clear visibility below which a scene says nothing about a light."""
CLEAR_QUANTILE = 0.9
"""Quantile of the views' visibilities that counts as clear: a light may be hidden in most of them."""
CONE_RADII = 4
"""Slope, in radii of the disk, of the cone about a line of sight beyond which nothing hides the light: the corners of
the small picture are at 2 sqrt(2)."""
MAX_NEAR = 1e-3
"""Largest near plane of a line of sight, relative to the light's distance."""
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
    lights = model.positions_in(frame)
    camera = -pose[:3, :3].T @ pose[:3, 3]
    visibilities = _visibilities(scene, camera.expand(len(lights), 3), lights, settings, kernels)
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
    eyes = torch.stack([-pose[:3, :3].double().T @ pose[:3, 3].double() for pose in poses])
    lights = torch.stack([model.positions_in(frame).double() for frame in frames or [""] * len(poses)])  # (views, l, 3)
    visibilities = _visibilities(scene, eyes[:, None].expand_as(lights).reshape(-1, 3), lights.reshape(-1, 3), settings,
                                 kernels)
    clear = visibilities.view(lights.shape[:2]).quantile(CLEAR_QUANTILE, dim=0).clamp(max=1)
    return clear.masked_fill(clear < MIN_CLEAR, 0)


def occlusion_loss(scene: SceneGaussians, eye: Tensor, lights: Sequence[Tensor], settings: VisibilitySettings,
                   kernels: Kernels = "auto") -> Tensor | None:
    """Return the loss of a scene that hides lights (3,), which the frame of the camera at `eye` (3,) shows.

    Its gradient makes Gaussians in front of the lights more transparent, such as a sky at a wrong distance. It is the
    negative logarithm of the visibilities: behind many layers, the visibility itself hardly changes with a single
    layer. None without lights.
    """
    if not lights:
        return None
    visibilities = _visibilities(scene, eye.expand(len(lights), 3), torch.stack(list(lights)), settings, kernels)
    return -OCCLUSION_WEIGHT * (visibilities + MIN_VISIBILITY).log().sum()


def light_visibility(scene: SceneGaussians, eye: Tensor, light: Tensor, settings: VisibilitySettings | None = None,
                     kernels: Kernels = "auto") -> Tensor:
    """Return the visibility (scalar, 0..1) of a light at `light` (3,) from a camera at `eye` (3,); world units.

    A small camera looks from the eye at the light. The visibility is the mean transmittance of the Gaussians in
    between, over a Gaussian window: the light's soft disk.
    """
    return _visibilities(scene, eye[None], light[None], settings or VisibilitySettings(), kernels)[0]


class _SightLines(NamedTuple):
    """Lines of sight from cameras to m lights: poses (m, 4, 4), world to camera, of small cameras that look along them,
    and the least and the greatest depth (m, 2) at which a Gaussian hides the light, world units."""

    poses: Tensor
    depths: Tensor


def _visibilities(scene: SceneGaussians, eyes: Tensor, lights: Tensor, settings: VisibilitySettings,
                  kernels: Kernels) -> Tensor:
    """Return (m,), the `light_visibility` of each light from a camera; eyes, lights: (m, 3)."""
    if not len(lights):
        return scene.means.new_ones(0)
    lines = _sight_lines(scene, eyes, lights, settings)
    fused = fused_kernels(scene.means) if kernels in ("auto", "cpu") else None
    far = scene.far
    visibilities = None if fused is None else fused.mean_transmittances(
        scene.means, scene.quaternions, scene.log_scales, scene.opacity_logits, lines.poses, _intrinsics(settings),
        _disk_weights(settings.pixels), lines.depths, CONE_RADII * settings.radius,
        (0.0, 0.0, 0.0) if far is None else far.centre, math.inf if far is None else far.min_distance)
    if visibilities is None:
        return torch.stack([_mean_transmittance(scene, pose, depths, settings, kernels)
                            for pose, depths in zip(lines.poses, lines.depths.tolist(), strict=True)])
    return visibilities


def _sight_lines(scene: SceneGaussians, eyes: Tensor, lights: Tensor, settings: VisibilitySettings) -> _SightLines:
    """Return the lines of sight from eyes to lights, (m, 3) each. Nothing hides a light at the eye."""
    positions = eyes.double().numpy()
    forward = lights.double().numpy() - positions
    distances = np.linalg.norm(forward, axis=1)
    forward /= np.where(distances > 0, distances, 1)[:, None]
    # The roll is free: right is perpendicular to the axis that is least along the line.
    right = np.cross(np.eye(3)[np.abs(forward).argmin(1)], forward)
    right /= np.linalg.norm(right, axis=1).clip(1e-12)[:, None]
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    poses[:, :3, 3] = -np.einsum("mij,mj->mi", poses[:, :3, :3], positions)
    # At most the scene's near plane, so that everything a picture shows can hide a light.
    near = np.minimum(MAX_NEAR * distances, scene.near)
    far = np.where(distances > 0, (1 - settings.margin) * distances, -1)
    return _SightLines(torch.from_numpy(poses.astype(np.float32)), torch.from_numpy(np.stack([near, far], 1)))


def _intrinsics(settings: VisibilitySettings) -> Tensor:
    """Return the intrinsics (3, 3) of the small cameras, px: the picture's edge is at twice the disk's radius, which is
    the window's standard deviation."""
    half = settings.pixels / 2
    focal = half / (2 * settings.radius)
    return torch.tensor([[focal, 0, half], [0, focal, half], [0, 0, 1]])


def _mean_transmittance(scene: SceneGaussians, pose: Tensor, depths: Sequence[float], settings: VisibilitySettings,
                        kernels: Kernels) -> Tensor:
    """Return the mean transmittance (scalar, 0..1) of the Gaussians along a line of `_SightLines`, over the light's
    soft disk: the definition."""
    pose = pose.to(scene.means)
    rows = _find_occluders(scene, pose, depths, settings)
    if not len(rows):
        return scene.means.new_ones(())
    # Colours are not needed, and their gradient would cost most.
    colourless = scene.means.new_zeros(len(rows), 1, 3)
    means, quaternions, log_scales, opacity_logits = (
        part.index_select(0, rows)
        for part in (scene.means, scene.quaternions, scene.log_scales, scene.opacity_logits))
    size = settings.pixels
    alpha = rasterization(means, quaternions, log_scales, opacity_logits, colourless, pose,
                          _intrinsics(settings).to(pose), size, size, near=depths[0], depth=False, kernels=kernels,
                          raw=True).alpha
    return ((1 - alpha) * _disk_weights(size).to(pose)).sum()


@cache
def _disk_weights(size: int) -> Tensor:
    """Return the weights (size, size) of the pixels of a light's soft disk; they sum to 1."""
    offset = torch.arange(size) + 0.5 - size / 2
    window = torch.exp(-0.5 * (offset / (size / 4)) ** 2)
    weights = window[:, None] * window
    return weights / weights.sum()


@torch.no_grad()
def _find_occluders(scene: SceneGaussians, pose: Tensor, depths: Sequence[float], settings: VisibilitySettings
                    ) -> Tensor:
    """Return the rows of Gaussians between camera and light that may touch the small picture, without the far layer.

    pose: world_to_camera (4, 4), on the scene's device. depths: least and greatest, of `_SightLines`.
    """
    x, y, depth = (scene.means @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    reach = OCCLUDER_REACH * scene.log_scales.amax(-1).exp()
    between = (depth > depths[0]) & (depth < depths[1])
    if scene.far is not None:
        between &= ~scene.far.contains(scene.means)
    return torch.nonzero(between & (torch.hypot(x, y) < depth * settings.radius * CONE_RADII + reach))[:, 0]
