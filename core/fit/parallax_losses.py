# SPDX-License-Identifier: GPL-3.0-or-later
"""What teaches the scene of a fit by parallax, which has no exact flare-free frames.

Frame = encode(scene + flare) leaves open who takes what both could make. Two things decide. A flare only adds light,
so no frame is darker than the scene. And what both could make is the flare's: above all the glow about a light, which
moves with the light as a part of the scene there would. The light's own disc is the scene's. Where the scene is slow to
find, as plain walls are, what it lacks would become the flare's too, a haze over the frame; so then what both could
make is the flare's near the lights alone. Flare-free frames that are estimates (mode `estimated`) help to find it, and
tell of flare that is far from them.
"""
from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from ..capture import Camera
from ..capture.discs import squared_distances
from ..gaussians.loss import l1_ssim
from .frames import Targets
from .settings import SplitSettings

FOUND_WHOLLY = 1e9
"""`times_found` of a scene that is nowhere brighter than the frames."""


def head_start(settings: SplitSettings, views: int, iterations: int) -> int:
    """Iterations, of so many, in which the scene of a fit to so many views is fitted alone."""
    return min(settings.rounds * views, iterations // 3)


def scene_beside_flare(scene: Tensor, targets: Targets, lights: ArrayLike, discs: Tensor | None,
                       settings: SplitSettings, progress: float) -> Tensor:
    """Loss of a scene (height, width, 3) of display values that is fitted with the flare, besides that of the two
    together. lights: (n, 3), world. discs: (height, width), the lights' own clipped pixels, if they are told.

    progress: of the fit, 0..1. The farther it is, the less the scene is drawn up to brighter frames, and the more held
    down near the lights.
    """
    share = _settled(progress)
    loss = settings.weight * from_below(scene, targets.frame, settings.excess * (1 - share))
    near = torch.from_numpy(nearness(targets.camera, lights, settings.reach))
    loss = loss + settings.glow * share * (scene * near[..., None]).mean()
    if discs is not None:
        loss = loss + ((scene - targets.frame).abs() * discs[..., None]).mean()
    return loss


def towards_estimate(scene: Tensor, estimate: Tensor, ssim_share: float, progress: float) -> Tensor:
    """Loss that draws a scene to an estimated flare-free frame, display values (height, width, 3) both, the less the
    farther the fit is (progress, 0..1): parts of the flare that were left in the estimate go then. ssim_share:
    1 - lambda, as of the fit's other losses."""
    drawn = 1 - _settled(progress)
    return drawn * l1_ssim(scene, estimate, 1 - ssim_share) if drawn else scene.new_zeros(())


def haze(added: Tensor, told: Tensor | None, times: float, camera: Camera, lights: ArrayLike,
         settings: SplitSettings) -> Tensor:
    """Loss of what a flare adds to the display values of a scene that was not found, (height, width, 3), away from
    where lights (n, 3), world, are seen. To leave out what the frame shows costs more than this, so ghosts, which the
    scene cannot take over, stay; what the scene can make as well goes to it.

    told: what the flare adds by an estimated flare-free frame, if there is one; times: `times_found` of the scene. The
    nearer that is to `settings.found`, the more of what is told costs nothing.
    """
    if told is not None:
        believed = (times - settings.lost) / max(settings.found - settings.lost, 1e-9)
        added = (added - min(max(believed, 0), 1) * told.clamp(min=0)).clamp(min=0)
    far = torch.from_numpy(1 - nearness(camera, lights, settings.reach))
    return settings.haze * (added * far[..., None]).mean()


def _settled(progress: float) -> float:
    """How far, 0..1, the scene is left to itself at a point of the fit, 0..1: wholly from its middle on."""
    return min(2 * progress, 1.0)


def from_below(scene: Tensor, frame: Tensor, excess: float) -> Tensor:
    """Mean |scene - frame|, display values (height, width, 3), of which what the frame has more counts for `excess`:
    fitted to several frames, their excess / (1 + excess) quantile."""
    more = frame - scene
    return torch.where(more > 0, more * excess, -more).mean()


def times_found(residuals: Iterable[Tensor]) -> float:
    """How many times what frames have less than the scene, squared, they have more, at most `FOUND_WHOLLY`: the more,
    the more of that is flare. residuals: frame - scene (height, width, 3) of some views, display values."""
    more = less = 0.0
    for residual in residuals:
        more += float(residual.clamp(min=0).square().mean())
        less += float(residual.clamp(max=0).square().mean())
    return more / less if more < FOUND_WHOLLY * less else FOUND_WHOLLY


def nearness(camera: Camera, lights: ArrayLike, reach: float) -> NDArray[np.float32]:
    """(height, width): 1 where a light (n, 3), world, is seen, a half at `reach` of the width beside."""
    return 1 / (1 + squared_distances(camera, lights) / np.float32(reach**2))
