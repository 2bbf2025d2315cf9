# SPDX-License-Identifier: GPL-3.0-or-later
"""Scene and flare put together, as a picture for the loss and as layers for the compositor.

Two ways, a setting of the fit:

over  the paper's: flare Gaussians hide what lies behind, in display space. All of them lie in front of
      every scene Gaussian, so the joint picture is C_flare + T_flare * C_scene.
add   light adds: I = encode(scene_linear + flare_linear), clipped as a camera clips, at white; frames of a format
      that does not clip there have a white above 1.

Layers are scene-linear whichever way was fitted, and scene + flare = composite in every pixel.
"""
from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..choices import Blend, Kernels
from ..colour.srgb_torch import decode, decoded_with_slope, encoded_with_slope
from ..conventions.exposures import brightness
from ..conventions.pixel_grid import Sampling
from ..gaussians import Splats, over, splat
from ..gaussians.rasterizer import Resolution
from . import placement
from .placement import PlaneGaussians


def splat_flare(gaussians: PlaneGaussians, intrinsics: Tensor, width: int, height: int, blend: Blend, *,
                kernels: Kernels = "auto", resolution: Resolution = "full",
                sampling: Sampling | None = None, exposure: float = 1.0) -> Splats:
    """The flare's colour (height, width, 3) and transmittance (height, width) under these intrinsics. sampling: the
    grid on which it was learned, so that it looks alike at every size. exposure: times the light that was learned.

    The colour is in display space for `over` and scene-linear for `add`.
    """
    centres, covariances = placement.pixels(gaussians, intrinsics, sampling)
    arcs = None if gaussians.arcs is None else placement.slopes(gaussians.arcs, covariances, intrinsics)
    colours = gaussians.colours if exposure == 1 else brightness(exposure, blend) * gaussians.colours
    return splat(centres, covariances, gaussians.opacities, colours, width, height,
                 rings=gaussians.rings, arcs=arcs, blend=blend, kernels=kernels, resolution=resolution)


def joined(flares: Mapping[str, PlaneGaussians]) -> PlaneGaussians | None:
    """All lights' Gaussians as one set, in the lights' order; None where no light is in front of the camera."""
    sets = list(flares.values())
    if not sets:
        return None
    means, covariances, opacities, colours = (torch.cat(parts) for parts in zip(*(s[:4] for s in sets), strict=True))
    return PlaneGaussians(means, covariances, opacities, colours,
                          _joined([(one.rings, len(one.means)) for one in sets], means.new_tensor([0.0, 1.0])),
                          _joined([(one.arcs, len(one.means)) for one in sets], means.new_zeros(2)))


def _joined(parts: list[tuple[Tensor | None, int]], plain: Tensor) -> Tensor | None:
    """Rows of all parts, `plain` for each of those that have none; None if none has."""
    if all(rows is None for rows, _ in parts):
        return None
    return torch.cat([plain.expand(count, -1) if rows is None else rows for rows, count in parts])


def composite(scene: Tensor, flare: Splats | None, blend: Blend, white: float = 1.0) -> Tensor:
    """The picture in display space: scene (height, width, 3) in display space, with the flare before it. white: display
    value at which light that adds is clipped."""
    if flare is None:
        return scene
    if blend == "over":
        return over(flare, scene)
    added: Tensor = _LightAdded.apply(scene, flare.colour, white)
    return added


class _LightAdded(torch.autograd.Function):
    """encode(decode(scene) + light), clipped to 0..white on the way in and out, with the gradient passed on as it is.

    A pixel that is too bright must be able to come down again; the true gradient of a clip is zero there.
    """

    @staticmethod
    def forward(ctx: Any, scene: Tensor, light: Tensor, white: float) -> Tensor:
        linear, within = decoded_with_slope(scene.clamp(0, white))
        shown, slope = encoded_with_slope(linear.add_(light))
        ctx.save_for_backward(within if ctx.needs_input_grad[0] else None, slope)
        return shown.clamp_(0, white)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor, None]:
        within, slope = ctx.saved_tensors
        of_light = gradient * slope
        return None if within is None else of_light * within, of_light, None


class Layers(NamedTuple):
    """Scene-linear layers of a view, (height, width, 3) each; scene + flare = composite.

    flares: by light; they sum to `flare`.
    """

    composite: Tensor
    scene: Tensor
    flare: Tensor
    flares: dict[str, Tensor]


def layers(scene: Tensor, flares: Mapping[str, Splats], blend: Blend, white: float = 1.0) -> Layers:
    """Layers from the scene's picture in display space, clipped at `white`, and each light's splats, in the lights'
    order.

    `over` is not a sum: a light's layer is what the picture gains in linear light when that light is put
    before those that follow it, so the layers add up to the whole exactly.
    """
    display = scene.clamp(0, white)
    scene_linear = decode(display)
    parts: dict[str, Tensor] = {}
    if blend == "add":
        parts = {name: splats.colour for name, splats in flares.items()}
        total = sum(parts.values(), torch.zeros_like(scene_linear))
        return Layers(scene_linear + total, scene_linear, total, parts)
    below, picture = scene_linear, display
    for name, splats in reversed(list(flares.items())):  # the first light lies in front
        picture = over(splats, picture)
        above = decode(picture.clamp_min(0))
        parts[name] = above - below
        below = above
    return Layers(below, scene_linear, below - scene_linear, {name: parts[name] for name in flares})
