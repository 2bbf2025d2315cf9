# SPDX-License-Identifier: GPL-3.0-or-later
"""What a rasterizer returns, and the numbers that every kernel set agrees on."""
from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..choices import Blend
from ..conventions.splatting import ALPHA_MIN as ALPHA_MIN
from ..conventions.splatting import OPACITY_MAX as OPACITY_MAX
from ..conventions.splatting import PROFILE_MIN as PROFILE_MIN

TRANSMITTANCE_MIN = 1e-4
"""A pixel is finished once its transmittance has fallen below this: later Gaussians do not count."""
STRENGTH2_MIN = 1e-16
"""Arcs whose squared strength is below this have no direction, nor a gradient by it."""
NEAR = 0.2
"""Gaussians at this camera depth or nearer are culled."""


@dataclass(frozen=True)
class Rendering:
    """A scene seen by one camera. h, w: the picture; n: the Gaussians, in the caller's order.

    colour            (h, w, 3)  background included; in the units of the colours
    alpha             (h, w)     0..1, one minus the transmittance left behind all Gaussians
    depth             (h, w)     mean camera depth, weighted by contribution; 0 where alpha is 0
    median_depth      (h, w)     depth of the Gaussian at which transmittance falls below 1/2, 0 where
                                 none does; not differentiable. Both (0, 0) if not asked for
    centres           (n, 2)     projected centres, px; 0 for those culled; detached
    radii             (n,)       3 sigma of the longer axis, px; 0 for those that touch no pixel; detached
    centre_gradients  (n, 2)     zero until backward, which adds the gradient of the loss by the centres,
                                 px^-1 (the statistic that densification goes by)
    """

    colour: Tensor
    alpha: Tensor
    depth: Tensor
    median_depth: Tensor
    centres: Tensor
    radii: Tensor
    centre_gradients: Tensor


@dataclass(frozen=True)
class Splats:
    """2D Gaussians on a picture: colour (h, w, 3) and the transmittance (h, w) they leave to what lies
    behind (ones where light is added), so that the whole picture is colour + transmittance * behind."""

    colour: Tensor
    transmittance: Tensor


def activated(scales: Tensor, opacities: Tensor, raw: bool) -> tuple[Tensor, Tensor]:
    """Standard deviations (n, 3) and opacities (n,) from what `rasterization` was given: if raw, logs and logits."""
    return (scales.exp(), opacities.sigmoid()) if raw else (scales, opacities)


def arc_strengths(covariances: Tensor, arcs: Tensor) -> Tensor:
    """(n,) beta = sqrt(b^T covariance b) of arcs (n, 2 or more) that begin with b, px^-1; at least sqrt(STRENGTH2_MIN).

    In double precision where there is any: on needles the terms of the sum cancel.
    """
    wide = torch.float32 if arcs.device.type == "mps" else torch.float64
    xx, xy, yy = covariances.to(wide).unbind(-1)
    x, y = arcs[:, :2].to(wide).unbind(-1)
    return (xx * x * x + 2 * xy * x * y + yy * y * y).clamp(min=STRENGTH2_MIN).sqrt()


def levelled(arcs: Tensor, covariances: Tensor, rings: Tensor | None) -> Tensor:
    """(n, 3) b and m from b (n, 2), px^-1: kernels take m = beta r0 + beta² w² / 2 off b·d, so that profiles peak at 1.

    In every direction the profile is highest somewhere on a ray, with c the cosine from that of the peak:

        -(r - r0)² / (2 w²) + beta r c - m  =  -(r - r0 - w² beta)² / (2 w²) - beta r (1 - c)

    So it is nowhere above a ring of radius r0 + w² beta and width w, which `extent` goes by, and meets it at c = 1.
    """
    beta = arc_strengths(covariances, arcs)
    r0, w = (0.0, 1.0) if rings is None else rings.to(beta.dtype).unbind(-1)
    return torch.cat([arcs, (beta * (r0 + beta * w * w / 2)).to(arcs.dtype)[:, None]], -1)


def extent(
    peaks: Tensor, blend: Blend = "over", rings: Tensor | None = None, strengths: Tensor | None = None
) -> Tensor:
    """(n,) Mahalanobis radius beyond which a Gaussian, or a ring (n, 2), or an arc of this strength (n,) of either, is
    skipped; 0 if all of it is.

    peaks: (n,) opacities, already clamped. Solves peak * exp(-r²/2) = threshold for r; arcs: see `levelled`.
    """
    if blend == "add":
        reach = torch.full_like(peaks, math.sqrt(-2 * math.log(PROFILE_MIN)))
    else:
        reach = (2 * (peaks / ALPHA_MIN).clamp(min=1.0).log()).sqrt()
    if rings is not None:
        reach = rings[:, 0] + rings[:, 1] * reach
    if strengths is not None:
        reach = reach + strengths.to(reach.dtype) * (1.0 if rings is None else rings[:, 1].square())
    reach = reach.clamp(min=0)
    return reach if blend == "add" else reach.masked_fill(peaks < ALPHA_MIN, 0)


def record_gradient(centres: Tensor, index: Tensor, n: int) -> Tensor:
    """(n, 2) zeros, to which backward will add the gradient by the centres (m, 2) of the Gaussians `index`."""
    gradients = torch.zeros(n, 2, dtype=torch.float32, device=centres.device)

    def record(gradient: Tensor) -> None:
        gradients.index_add_(0, index, gradient.to(gradients.dtype))

    if centres.requires_grad:
        centres.register_hook(record)
    return gradients
