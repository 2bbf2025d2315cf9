# SPDX-License-Identifier: GPL-3.0-or-later
"""Composites flare over scene, as a picture for the loss and as layers for a compositor.

Two ways, a setting of the fit:
`over`, the paper's: flare Gaussians hide what lies behind, in display space. All of them lie in front of every scene
Gaussian, so the composite is C_flare + T_flare * C_scene.
`add`: light adds, I = encode(scene_linear + flare_linear), clipped at white as a camera clips; frames of a format that
does not clip there have a white above 1.

Layers are scene-linear in both, and scene + flare = composite in every pixel. `core.fit` and `core.bake` call this.
"""
from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, cast

import torch
from torch import Tensor

from ..choices import Blend, Kernels
from ..colour.srgb_torch import decode, decode_with_slope, encode_with_slope
from ..conventions.exposures import colour_scale
from ..conventions.pixel_grid import PixelGrid
from ..gaussians import Splats, over, splat
from ..gaussians.kernels import fused_kernels
from ..gaussians.rasterizer import Resolution
from . import placement
from .placement import PlaneGaussians


def splat_flare(gaussians: PlaneGaussians, intrinsics: Tensor, width: int, height: int, blend: Blend, *,
                kernels: Kernels = "auto", resolution: Resolution = "full",
                pixel_grid: PixelGrid | None = None, exposure: float = 1.0) -> Splats:
    """Rasterize flare Gaussians under intrinsics (3, 3): colour (height, width, 3), transmittance (height, width).

    The colour is in display space for the blend "over", scene-linear for "add". pixel_grid: the grid at which the flare
    was fitted, so that it looks alike at every size; None for the default low-pass filter. exposure: factor on the
    fitted light.
    """
    centres, covariances = placement.to_pixels(gaussians, intrinsics, pixel_grid)
    arcs = None if gaussians.arcs is None else placement.arcs_to_pixels(gaussians.arcs, covariances, intrinsics)
    colours = gaussians.colours if exposure == 1 else colour_scale(exposure, blend) * gaussians.colours
    return splat(centres, covariances, gaussians.opacities, colours, width, height,
                 rings=gaussians.rings, arcs=arcs, blend=blend, kernels=kernels, resolution=resolution)


def concatenate(flares: Mapping[str, PlaneGaussians]) -> PlaneGaussians | None:
    """Concatenate the Gaussians of all lights, in the lights' order; None if no light is in front of the camera."""
    sets = list(flares.values())
    if not sets:
        return None
    means, covariances, opacities, colours = (torch.cat(parts) for parts in zip(*(s[:4] for s in sets), strict=True))
    # A ring of r0 = 0 and w = 1, and an arc of 0, are a plain Gaussian.
    rings = _concatenate_rows([(s.rings, len(s.means)) for s in sets], means.new_tensor([0.0, 1.0]))
    arcs = _concatenate_rows([(s.arcs, len(s.means)) for s in sets], means.new_zeros(2))
    return PlaneGaussians(means, covariances, opacities, colours, rings, arcs)


def _concatenate_rows(parts: list[tuple[Tensor | None, int]], plain: Tensor) -> Tensor | None:
    """Concatenate the rows (n, k) of several sets of n Gaussians; None if no set has rows.

    parts: rows and n of each set. plain: (k,), the row for each Gaussian of a set without rows.
    """
    if all(rows is None for rows, _ in parts):
        return None
    return torch.cat([plain.expand(count, -1) if rows is None else rows for rows, count in parts])


def composite(scene: Tensor, flare: Splats | None, blend: Blend, white: float = 1.0,
              black: Tensor | None = None) -> Tensor:
    """Return the composite (height, width, 3) of scene and flare, display values.

    scene: (height, width, 3), display values. flare: splats of all lights, None without any. white: display value at
    which added light is clipped. black: (height, width), True where the flare is composited over black, or None.
    """
    if flare is not None and blend == "add":
        return add_light(scene, flare.colour, white, black)
    behind = scene if black is None else scene.masked_fill(black[..., None], 0)
    return behind if flare is None else over(flare, behind)


def add_light(scene: Tensor, light: Tensor, white: float, black: Tensor | None = None, *,
              kernels: Literal["auto", "torch"] = "auto") -> Tensor:
    """Return encode(decode(scene) + light), clipped to 0..white before and after, display values (height, width, 3).

    light: (height, width, 3), scene-linear. black: as for `composite`. The clips have a straight-through gradient: the
    true one is zero there, and a pixel that is too bright must be able to become darker. kernels: "torch" disables the
    fused CPU kernel.
    """
    fused = fused_kernels(scene) if kernels == "auto" and light.dtype == scene.dtype else None
    added = None if fused is None else fused.add_light(scene, light, white, black)
    if added is None:
        behind = scene if black is None else scene.masked_fill(black[..., None], 0)
        added = cast(Tensor, _AddLight.apply(behind, light, white))
    return added


class _AddLight(torch.autograd.Function):
    """The definition of `add_light`, without its mask."""

    @staticmethod
    def forward(ctx: Any, scene: Tensor, light: Tensor, white: float) -> Tensor:
        linear, decode_slope = decode_with_slope(scene.clamp(0, white))
        display, encode_slope = encode_with_slope(linear.add_(light))
        ctx.save_for_backward(decode_slope if ctx.needs_input_grad[0] else None, encode_slope)
        return display.clamp_(0, white)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor, None]:
        decode_slope, encode_slope = ctx.saved_tensors
        light_gradient = gradient * encode_slope
        return None if decode_slope is None else light_gradient * decode_slope, light_gradient, None


class LinearLayers(NamedTuple):
    """Scene-linear layers of a view, (height, width, 3) each; scene + flare = composite. flares: by light; they sum to
    `flare`."""

    composite: Tensor
    scene: Tensor
    flare: Tensor
    flares: dict[str, Tensor]

    def to(self, device: torch.device) -> LinearLayers:
        """Return the layers on a device."""
        return LinearLayers(self.composite.to(device), self.scene.to(device), self.flare.to(device),
                            {name: layer.to(device) for name, layer in self.flares.items()})


def linear_layers(scene: Tensor, flares: Mapping[str, Splats], blend: Blend, white: float = 1.0) -> LinearLayers:
    """Return layers from the scene's picture, display values (height, width, 3), and each light's splats.

    flares: splats by light; the first lies in front. white: display value at which the scene is clipped; the composite
    is not. With the blend "over", lights are put over the scene from the last to the first, and a light's layer is the
    increase of the linear picture by it, so the layers sum to the composite exactly.
    """
    display = scene.clamp(0, white)
    scene_linear = decode(display)
    flare_layers: dict[str, Tensor] = {}
    if blend == "add":
        flare_layers = {name: splats.colour for name, splats in flares.items()}
        total = sum(flare_layers.values(), torch.zeros_like(scene_linear))
        return LinearLayers(scene_linear + total, scene_linear, total, flare_layers)
    below, picture = scene_linear, display
    for name, splats in reversed(list(flares.items())):  # the first light lies in front
        picture = over(splats, picture)
        above = decode(picture.clamp_min(0))
        flare_layers[name] = above - below
        below = above
    return LinearLayers(below, scene_linear, below - scene_linear, {name: flare_layers[name] for name in flares})
