# SPDX-License-Identifier: GPL-3.0-or-later
"""Results of a rasterizer, and the thresholds and formulas that all kernel sets share."""
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
"""Transmittance below which a pixel is finished: Gaussians behind are skipped."""
STRENGTH2_MIN = 1e-16
"""Squared strength of an arc below which it has no direction and no gradient by it."""
OCCLUDER_REACH = 3.0
"""Largest standard deviations of a Gaussian up to which it may hide a light."""
NEAR = 0.2
"""Camera depth up to which Gaussians are culled, world units."""


@dataclass(frozen=True)
class Rendering:
    """A scene seen by one camera. h, w: size of the picture; n: number of Gaussians, in the caller's order.

    colour            (h, w, 3)  background included; in the units of the colours
    alpha             (h, w)     0..1, one minus the transmittance left behind all Gaussians
    depth             (h, w)     mean camera depth, weighted by contribution; 0 where alpha is 0
    median_depth      (h, w)     depth of the Gaussian at which transmittance falls below 1/2, 0 if none
                                 does; not differentiable. Both depths are (0, 0) with depth=False
    centres           (n, 2)     projected centres, px; 0 for culled Gaussians; detached
    radii             (n,)       3 sigma of the longer axis, px; 0 for Gaussians that touch no pixel; detached
    centre_gradients  (n, 2)     zero until backward, which adds the gradient of the loss by the centres,
                                 px^-1 (the statistic of densification)
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
    """Rasterized 2D Gaussians: colour (h, w, 3) and transmittance (h, w), which is one for the blend "add". The
    composite over a background is colour + transmittance * background."""

    colour: Tensor
    transmittance: Tensor


def activate(scales: Tensor, opacities: Tensor, raw: bool) -> tuple[Tensor, Tensor]:
    """Return standard deviations (n, 3) and opacities (n,); raw: the arguments are logarithms and logits."""
    return (scales.exp(), opacities.sigmoid()) if raw else (scales, opacities)


def arc_strengths(covariances: Tensor, arcs: Tensor) -> Tensor:
    """Return (n,) strengths of arcs, beta = sqrt(b^T covariance b), at least sqrt(STRENGTH2_MIN).

    arcs: (n, 2 or more), of which the first two columns are b, px^-1. covariances: (n, 3) xx, xy, yy, px².

    In double precision if the device has it, since the terms cancel for needles.
    """
    wide = torch.float32 if arcs.device.type == "mps" else torch.float64
    xx, xy, yy = covariances.to(wide).unbind(-1)
    x, y = arcs[:, :2].to(wide).unbind(-1)
    return (xx * x * x + 2 * xy * x * y + yy * y * y).clamp(min=STRENGTH2_MIN).sqrt()


def normalise_arcs(arcs: Tensor, covariances: Tensor, rings: Tensor | None) -> Tensor:
    """Return (n, 3), b and m, from arcs b (n, 2), px^-1; with m = beta r0 + beta² w² / 2, which kernels subtract from
    b·d, profiles have a peak of 1.

    beta: strength of the arc; r0, w: of the ring, 0 and 1 without one; r: Mahalanobis distance.

    Along a ray at an angle of cosine c to the direction of the peak, the logarithm of the profile is

        -(r - r0)² / (2 w²) + beta r c - m  =  -(r - r0 - w² beta)² / (2 w²) - beta r (1 - c)

    so the profile is nowhere above a ring of radius r0 + w² beta and width w, which `cutoff_radii` uses, and equals it
    at c = 1.
    """
    beta = arc_strengths(covariances, arcs)
    r0, w = (0.0, 1.0) if rings is None else rings.to(beta.dtype).unbind(-1)
    return torch.cat([arcs, (beta * (r0 + beta * w * w / 2)).to(arcs.dtype)[:, None]], -1)


def cutoff_radii(
    peaks: Tensor, blend: Blend = "over", rings: Tensor | None = None, strengths: Tensor | None = None
) -> Tensor:
    """Return (n,) Mahalanobis radii beyond which Gaussians are not drawn; with "over", 0 for peaks below ALPHA_MIN.

    peaks: (n,) opacities, at most OPACITY_MAX. rings: (n, 2) r0 and w. strengths: (n,) strengths beta of arcs.

    The radius r of a plain Gaussian solves peak * exp(-r²/2) = ALPHA_MIN with "over", exp(-r²/2) = PROFILE_MIN with
    "add". The radius of a ring is r0 + w r. An arc adds w² beta to it, where w is 1 without a ring.
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
    """Return (n, 2) zeros, to whose rows `index` (m,) the backward pass will add the gradients by `centres` (m, 2).
    """
    gradients = torch.zeros(n, 2, dtype=torch.float32, device=centres.device)

    def record(gradient: Tensor) -> None:
        gradients.index_add_(0, index, gradient.to(gradients.dtype))

    if centres.requires_grad:
        centres.register_hook(record)
    return gradients
