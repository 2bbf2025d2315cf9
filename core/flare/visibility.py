# SPDX-License-Identifier: GPL-3.0-or-later
"""How much of a light the camera sees past the scene (ours; docs/decisions/visibility.md).

A small camera at the view's position looks straight at the light, in the frame or not, and rasterises the
scene Gaussians that lie before it; what transmittance is left over a soft disk is the visible share. It is
differentiable by the scene's Gaussians, and fades as a light with a size fades.

A scene that is learned from pictures hides every light a little: Gaussians that show the lamp, or a sky without
depth, stand before it. So shares are taken of what the training views that see most of the light see (`clear`).
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..choices import Kernels
from ..gaussians import rasterization
from ..gaussians.scene import SceneGaussians
from ..look.shot import LIGHT_MARGIN, LIGHT_RADIUS
from .model import FlareModel

LEAST_CLEAR = 0.01
CLEAR_FROM = 0.9
"""Quantile of the views' shares that counts as clear: a light may be hidden in most of them."""
COVERED, LEAST_SHARE = 1e-4, 1e-6
"""Weight of the loss of a covered light, about that of the pixels that show it; and what is added to its share."""


@dataclass(frozen=True)
class VisibilitySettings:
    """radius: of the light's disk, as a share of its distance. margin: Gaussians nearer to the light than this
    share of its distance do not hide it, since they show the lamp itself. pixels: the small picture's side."""

    radius: float = LIGHT_RADIUS
    margin: float = LIGHT_MARGIN
    pixels: int = 9


def visible_shares(scene: SceneGaussians, model: FlareModel, world_to_camera: Tensor, settings: VisibilitySettings,
                   kernels: Kernels = "auto") -> dict[str, Tensor]:
    """The visible share of each light from a pose (4, 4), by the light's name, as part of `FlareModel.clear`."""
    pose = world_to_camera.double()
    camera = -pose[:3, :3].T @ pose[:3, 3]
    return {name: of_clear(visible_share(scene, camera, light, settings, kernels), clear)
            for name, light, clear in zip(model.names, model.positions, model.clear, strict=True)}


def of_clear(share: Tensor, clear: Tensor | float) -> Tensor:
    """A visible share as part of what the scene leaves of the light where nothing hides it; see `FlareModel.clear`."""
    return (share / clear).clamp(max=1) if clear > 0 else torch.ones(())


@torch.no_grad()
def share_seen(scene: SceneGaussians, camera: NDArray[np.float64], light: NDArray[np.float64],
               settings: VisibilitySettings, clear: float = 1.0) -> float:
    """The visible share, 0..1, of a light at `light` (3,) from a camera at `camera` (3,), world units, as part of
    `clear` (`FlareModel.clear`), which is 1 where the scene is not the one that the light was fitted with."""
    return float(of_clear(visible_share(scene, torch.from_numpy(camera), torch.from_numpy(light), settings), clear))


@torch.no_grad()
def clear_shares(scene: SceneGaussians, model: FlareModel, poses: Sequence[Tensor], settings: VisibilitySettings,
                 kernels: Kernels = "auto") -> Tensor:
    """(lights,) the share that the scene leaves of each light where nothing hides it: what it leaves in the clearest
    tenth of these poses (4, 4). 0 where even those see less than `LEAST_CLEAR`: a scene that hides a light from
    everywhere, as one does that the light was placed inside of, says nothing about it, and its shares are 1."""
    cameras = [-pose[:3, :3].double().T @ pose[:3, 3].double() for pose in poses]
    found = []
    for light in model.positions:
        shares = torch.stack([visible_share(scene, camera, light, settings, kernels) for camera in cameras])
        found.append(shares.quantile(CLEAR_FROM))
    least = torch.stack(found).clamp(max=1)
    return least.masked_fill(least < LEAST_CLEAR, 0)


def uncovering(scene: SceneGaussians, camera: Tensor, lights: Sequence[Tensor], settings: VisibilitySettings,
               kernels: Kernels = "auto") -> Tensor | None:
    """Loss of a scene that hides lights (3,) from a camera at `camera` (3,) that shows them: it thins what stands
    before them, such as a sky, of which pictures do not say how far it is. None without a light.

    The logarithm of the shares, since of many layers each alone would change next to nothing.
    """
    shares = [visible_share(scene, camera, light, settings, kernels) for light in lights]
    return -COVERED * (torch.stack(shares) + LEAST_SHARE).log().sum() if shares else None


def visible_share(scene: SceneGaussians, camera: Tensor, light: Tensor, settings: VisibilitySettings | None = None,
                  kernels: Kernels = "auto") -> Tensor:
    """The share (scalar, 0..1) of a light at `light` (3,) that a camera at `camera` (3,) sees; world units."""
    settings = settings or VisibilitySettings()
    away = (light - camera).float()
    distance = float(away.norm())
    if distance <= 0:
        return torch.ones(())
    pose = _looking_along(camera.float(), away / distance)
    chosen = _before(scene, pose, distance, settings)
    size, half = settings.pixels, settings.pixels / 2
    # The disk's edge, two deviations of the window, is the picture's edge.
    focal = half / (2 * settings.radius)
    intrinsics = torch.tensor([[focal, 0, half], [0, focal, half], [0, 0, 1]])
    near = _near(scene, distance)
    colourless = scene.sh.new_zeros(len(chosen), 1, 3)  # the colours' gradient would be the dearest part
    alpha = rasterization(scene.means[chosen], scene.quaternions[chosen], scene.log_scales[chosen].exp(),
                          scene.opacity_logits[chosen].sigmoid(), colourless, pose, intrinsics, size, size,
                          near=near, depth=False, kernels=kernels).alpha
    offset = torch.arange(size) + 0.5 - half
    window = torch.exp(-0.5 * (offset / (half / 2)) ** 2)
    weights = window[:, None] * window
    return ((1 - alpha) * weights).sum() / weights.sum()


def _near(scene: SceneGaussians, distance: float) -> float:
    """Depth from which on a light so far away is hidden: what a picture shows hides one however far it is."""
    return min(1e-3 * distance, scene.near)


def _before(scene: SceneGaussians, pose: Tensor, distance: float, settings: VisibilitySettings) -> Tensor:
    """Rows of the Gaussians between camera and light that may touch the small picture. By numpy, which has a third of
    torch's cost on columns of three."""
    means, scales, rigid = (part.detach().cpu().numpy() for part in (scene.means, scene.log_scales, pose))
    x, y, depth = (means @ rigid[:3, :3].T + rigid[:3, 3]).T
    reach = 3 * np.exp(np.maximum(np.maximum(scales[:, 0], scales[:, 1]), scales[:, 2]))
    between = (depth > _near(scene, distance)) & (depth < (1 - settings.margin) * distance)
    aside = np.sqrt(x * x + y * y)
    rows = np.flatnonzero(between & (aside < depth * settings.radius * 4 + reach))
    return torch.from_numpy(rows).to(scene.means.device)


def _looking_along(position: Tensor, forward: Tensor) -> Tensor:
    """world_to_camera (4, 4) of a camera that looks along the unit vector `forward`."""
    helper = torch.eye(3)[int(forward.abs().argmin())]
    right = torch.linalg.cross(helper, forward)
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ position
    return pose
