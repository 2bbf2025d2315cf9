# SPDX-License-Identifier: GPL-3.0-or-later
"""What teaches the scene of a mode `split` fit, which has no flare-free frames.

Frame = encode(scene + flare) leaves open who takes what both could make. Two things decide. A flare only adds light,
so no frame is darker than the scene. And what both could make is the flare's: above all the glow about a light, which
moves with the light as a part of the scene there would. The light's own disc is the scene's.
"""
from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from ..capture import Camera
from ..capture.discs import squared_distances
from .frames import Targets
from .settings import SplitSettings


class HeadStart:
    """How long the scene of a mode `split` fit is fitted alone, and how much brighter frames count for it.

    views: that are fitted. until: the last iteration of the scene alone, which `goes_on` puts off.
    """

    def __init__(self, settings: SplitSettings, views: int, iterations: int) -> None:
        self._settings = settings
        self._longest = iterations // 3
        self._rounds_end = min(settings.rounds * views, self._longest)
        self.until = self._rounds_end

    def asks_before(self, iteration: int) -> bool:
        """Whether this iteration, which would be the flare's first, waits for an answer of `is_found`."""
        return iteration == self._rounds_end + 1 <= self._longest

    def goes_on(self) -> None:
        """The scene has not been found."""
        self.until = self._longest

    @property
    def excess(self) -> float:
        """See `from_below`."""
        return self._settings.excess if self.until == self._rounds_end else self._settings.excess_unfound


def scene_beside_flare(scene: Tensor, targets: Targets, lights: ArrayLike, discs: Tensor | None,
                       settings: SplitSettings, excess: float, progress: float) -> Tensor:
    """Loss of a scene (height, width, 3) of display values that is fitted with the flare, besides that of the two
    together. lights: (n, 3), world. discs: (height, width), the lights' own clipped pixels, if they are told.
    excess: see `from_below`.

    progress: of the fit, 0..1. Until its middle the scene, which is still to be found, is less and less drawn up to
    brighter frames, and more and more held down near the lights.
    """
    settled = min(2 * progress, 1.0)
    loss = settings.weight * from_below(scene, targets.frame, excess * (1 - settled))
    near = torch.from_numpy(nearness(targets.camera, lights, settings.reach))
    loss = loss + settings.glow * settled * (scene * near[..., None]).mean()
    if discs is not None:
        loss = loss + ((scene - targets.frame).abs() * discs[..., None]).mean()
    return loss


def from_below(scene: Tensor, frame: Tensor, excess: float) -> Tensor:
    """Mean |scene - frame|, display values (height, width, 3), of which what the frame has more counts for `excess`:
    fitted to several frames, their excess / (1 + excess) quantile."""
    more = frame - scene
    return torch.where(more > 0, more * excess, -more).mean()


def is_found(residuals: Iterable[Tensor], times: float) -> bool:
    """Whether what frames have more than the scene, squared, is so many times what they have less: mostly flare, then.
    residuals: frame - scene (height, width, 3) of some views, display values."""
    more = less = 0.0
    for residual in residuals:
        more += float(residual.clamp(min=0).square().mean())
        less += float(residual.clamp(max=0).square().mean())
    return more >= times * less


def nearness(camera: Camera, lights: ArrayLike, reach: float) -> NDArray[np.float32]:
    """(height, width): 1 where a light (n, 3), world, is seen, a half at `reach` of the width beside."""
    return 1 / (1 + squared_distances(camera, lights) / np.float32(reach**2))
