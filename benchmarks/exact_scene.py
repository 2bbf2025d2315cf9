# SPDX-License-Identifier: GPL-3.0-or-later
"""A fit of the flare alone over the exact scene: the limit of the representation without the scene's errors."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from core.capture import View
from core.colour.srgb import srgb_from_linear
from core.colour.srgb_torch import decode
from core.errors import CaptureError
from core.fit.rendering import render_flare
from core.fit.trainer import Trainer
from core.flare.compositing import composite
from core.gaussians.loss import l1_ssim
from core.metrics.evaluation import unscored_mask
from core.metrics.pictures import psnr, relative_l2


class ExactSceneTrainer(Trainer):
    """A trainer whose scene is the clean frame of each view; all lights count as visible."""

    def step(self) -> dict[str, float]:
        """Make one iteration on the next view; return the loss."""
        self.iteration += 1
        settings = self.settings
        targets = self.frames.targets(self._pick_view())
        if targets.clean is None:
            raise CaptureError(f"{self.capture.folder} has no flare-free frames; the exact scene must be known.")
        self.optimisers.set_rates(self.iteration)
        flare = render_flare(self.flare, settings.blend, targets.camera, settings.kernels)
        loss = l1_ssim(composite(targets.clean, flare, settings.blend), targets.frame, 1 - settings.ssim_share)
        if loss.requires_grad:
            loss.backward()
        self.optimisers.step(scene=False)
        self._change_flare_density()  # adds and removes flare Gaussians as in any fit
        return {"loss": float(loss.detach())}


@torch.no_grad()
def score_flare(trainer: Trainer, views: Sequence[View]) -> dict[str, Any]:
    """Return the mean scores of the flare over views, under the names that `eval` uses.

    "flare": |composite - scene| in display values, compared with exact layers; without these, with frame minus clean
    frame. "flare_linear": the linear layer outside clipped pixels, compared with the exact one.
    """
    display_psnr, linear_psnr, relative_errors = [], [], []
    for view in views:
        targets = trainer.frames.targets(view)
        assert targets.clean is not None
        flare = render_flare(trainer.flare, trainer.settings.blend, targets.camera, trainer.settings.kernels)
        if flare is None:
            continue
        picture = composite(targets.clean, flare, trainer.settings.blend)
        rendered_display = (picture - targets.clean).abs().numpy()
        scene, truth = (read_layer(view, targets.camera.size) for read_layer in (trainer.capture.truth_scene,
                                                                                 trainer.capture.truth_flare))
        if scene is None or truth is None:
            display_psnr.append(psnr(rendered_display, (targets.frame - targets.clean).abs().numpy()))
            continue
        with_flare = srgb_from_linear(scene.linear() + truth.linear()).clip(0, 1)
        display_psnr.append(psnr(rendered_display, np.abs(with_flare - srgb_from_linear(scene.linear()).clip(0, 1))))
        is_scored = ~unscored_mask(trainer.capture, view, targets.camera.size)
        rendered = flare.colour if trainer.settings.blend == "add" else decode(picture) - decode(targets.clean)
        linear_psnr.append(psnr(rendered.numpy(), truth.linear(), is_scored))
        relative_errors.append(relative_l2(rendered.numpy(), truth.linear(), is_scored))
    return {"flare": {"psnr": _mean(display_psnr)},
            "flare_linear": {"psnr": _mean(linear_psnr), "relative_l2": _mean(relative_errors)}}


def _mean(values: Sequence[float]) -> float | None:
    """Return the mean of the finite values: a view without flare has no relative error."""
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else None
