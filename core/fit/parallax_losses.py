# SPDX-License-Identifier: GPL-3.0-or-later
"""Losses of the scene in a fit by parallax, which has no exact clean frames; `trainer` adds them up.

The frame is encode(scene + flare), and some light could belong to either. Two rules decide. First, a flare only adds
light, so no frame is darker than the scene. Second, light that both could explain goes to the flare. Most of it is the
glow about a light, which moves with the light as part of the scene there would. The light disc itself goes to the
scene. A scene that converges slowly, as plain walls do, would leave the missing light to the flare as a veil over the
frame. So while the scene has not converged, such light goes to the flare near the lights only. Estimated clean frames
(mode `estimated`) help the scene to converge, and show flare that is far from the lights.
"""
from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from ..capture import Camera
from ..capture.discs import squared_light_distances
from ..gaussians.loss import l1_ssim
from .frames import Targets
from .settings import SplitSettings

MAX_EXCESS_RATIO = 1e9
"""Largest `excess_ratio`, that of a scene that is nowhere brighter than the frames."""


def convergence(settings: SplitSettings, ratio: float) -> float:
    """Return how far a scene has converged, 0..1, by its `excess_ratio`.

    1 from `settings.converged_ratio` on, 0 from `settings.diverged_ratio` down.
    """
    span = max(settings.converged_ratio - settings.diverged_ratio, 1e-9)
    return min(max((ratio - settings.diverged_ratio) / span, 0.0), 1.0)


def ambiguity(settings: SplitSettings, views: int, ratio: float) -> float:
    """Return how little the parallax of a capture decides between scene and flare, 0..1.

    What its scene lacks of `convergence`, times the sparsity of its views: 0 from `settings.few_views` training views
    on, 1 from half of them down.
    """
    sparsity = min(max(settings.few_views / max(views, 1) - 1, 0.0), 1.0)
    return sparsity * (1 - convergence(settings, ratio))


def scene_only_iterations(settings: SplitSettings, views: int, iterations: int, ratio: float = MAX_EXCESS_RATIO) -> int:
    """Return the number of iterations, of `iterations`, in which the scene is fitted alone.

    `settings.scene_only_rounds` passes over the views, and up to a third of all iterations by the capture's
    `ambiguity`: these passes over few views can be too few steps for a scene to converge. ratio: the `excess_ratio`
    after the passes.
    """
    third = iterations // 3
    passes = min(settings.scene_only_rounds * views, third)
    return passes + round(ambiguity(settings, views, ratio) * (third - passes))


def scene_loss(scene: Tensor, targets: Targets, lights: ArrayLike, discs: Tensor | None,
               settings: SplitSettings, progress: float) -> Tensor:
    """Return the loss on the picture of the scene alone, (height, width, 3) display values, beside the composite's
    loss.

    It is a quantile loss, plus a penalty on the scene's light near the lights, plus an L1 loss in the discs. With
    `progress`, 0..1, brighter frames pull the scene up less, and the penalty grows until `low_sh_until`. lights: (n,
    3), world. discs: (height, width), the lights' clipped pixels, or None.
    """
    ramp = _ramp(progress)
    loss = settings.scene_weight * quantile_loss(scene, targets.frame, settings.excess_weight * (1 - ramp))
    proximity = torch.from_numpy(light_proximity(targets.camera, lights, settings.light_radius)).to(scene.device)
    final_share = 1 if progress <= settings.low_sh_until else settings.final_near_share
    loss = loss + settings.near_scene_penalty * ramp * final_share * (scene * proximity[..., None]).mean()
    # In the discs, the scene is fitted to the frame.
    if discs is not None:
        loss = loss + ((scene - targets.frame).abs() * discs[..., None]).mean()
    return loss


def estimate_loss(scene: Tensor, estimate: Tensor, ssim_share: float, progress: float) -> Tensor:
    """Return the loss of a scene against an estimated clean frame, display values (height, width, 3).

    Its weight falls to 0 by the middle of the fit (progress, 0..1), so that flare left in the estimate can be
    corrected. ssim_share: weight of SSIM against L1.
    """
    weight = 1 - _ramp(progress)
    return weight * l1_ssim(scene, estimate, 1 - ssim_share) if weight else scene.new_zeros(())


def far_flare_penalty(added: Tensor, estimated_flare: Tensor | None, ratio: float, camera: Camera, lights: ArrayLike,
                      settings: SplitSettings) -> Tensor:
    """Return the penalty on `added`, the light that a flare adds, far from the lights (n, 3), world.

    added: (height, width, 3), display values. The penalty is for a scene that has not converged. Missing a ghost costs
    more than this penalty, so ghosts, which the scene cannot reproduce, stay in the flare; other light moves to the
    scene. estimated_flare: frame minus estimated clean frame, or None. ratio: the scene's `excess_ratio`; from
    `settings.diverged_ratio` to `settings.converged_ratio` the exempt share of the estimated flare rises from 0 to 1.
    """
    if estimated_flare is not None:
        added = (added - convergence(settings, ratio) * estimated_flare.clamp(min=0)).clamp(min=0)
    far = torch.from_numpy(1 - light_proximity(camera, lights, settings.light_radius)).to(added.device)
    return settings.far_flare_penalty * (added * far[..., None]).mean()


def _ramp(progress: float) -> float:
    """Return 0..1, rising linearly with the progress 0..1 of a fit and 1 from its middle on."""
    return min(2 * progress, 1.0)


def quantile_loss(scene: Tensor, frame: Tensor, excess_weight: float) -> Tensor:
    """Return the pinball loss of a scene against a frame, display values (height, width, 3).

    The mean of |scene - frame|, times `excess_weight` where the frame is brighter. A scene fitted to several frames
    tends to their excess_weight / (1 + excess_weight) quantile.
    """
    excess = frame - scene
    return torch.where(excess > 0, excess * excess_weight, -excess).mean()


def excess_ratio(residuals: Iterable[Tensor]) -> float:
    """Return the squared excess of frames over the scene, divided by their squared deficit; at most MAX_EXCESS_RATIO.

    The larger the ratio, the more of the excess is flare: a flare only adds light, while errors have both signs.
    residuals: frame - scene (height, width, 3) of some views, display values.
    """
    excess = deficit = 0.0
    for residual in residuals:
        excess += float(residual.clamp(min=0).square().mean())
        deficit += float(residual.clamp(max=0).square().mean())
    return excess / deficit if excess < MAX_EXCESS_RATIO * deficit else MAX_EXCESS_RATIO


def light_proximity(camera: Camera, lights: ArrayLike, radius: float) -> NDArray[np.float32]:
    """Return (height, width), how near each pixel is to the nearest of the lights (n, 3), world: 1 at the light, 1/2 at
    a distance of `radius`, a share of the frame's width."""
    return 1 / (1 + squared_light_distances(camera, lights) / np.float32(radius**2))
