# SPDX-License-Identifier: GPL-3.0-or-later
"""Places flare Gaussians in the picture (paper, section "Flare Representation").

Everything is in normalised image coordinates (x/z, y/z, origin at the principal point p, y down), so a flare does not
depend on resolution and a change of focal length moves it as a lens would. A camera's intrinsics enter in `to_pixels`
and `arcs_to_pixels` only. `core.look.plane` has the same in numpy.
"""
from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from ..conventions.pixel_grid import PixelGrid, dilation
from ..gaussians.rendering import STRENGTH2_MIN
from ..look.plane import ARC_SOFTNESS, PLANE_DEPTH


class PlaneGaussians(NamedTuple):
    """Gaussians on the normalised plane, ready to be splatted.

    means (n, 2), covariances (n, 3) as xx, xy, yy, opacities (n,) in 0..1 (with arcs above 1, too: see `opacity_gain`),
    colours (n, 3), and rings (n, 2) as r0 and w in Mahalanobis radii (ours) or None. arcs (n, 2) or None: covariance
    times b, a vector of the plane from the mean towards the side that exp(b·d) brightens, d the offset from the mean;
    it scales and turns with the plane.
    """

    means: Tensor
    covariances: Tensor
    opacities: Tensor
    colours: Tensor
    rings: Tensor | None = None
    arcs: Tensor | None = None


def on_line(mu: Tensor, light: Tensor) -> Tensor:
    """Map mu (n, 1) to the plane (n, 2): 0 at the principal point, 1 at the light (2,), its delta_l included."""
    return mu * light


def project_covariances(means: Tensor, log_scales: Tensor, quaternions: Tensor) -> Tensor:
    """Return covariances (n, 3) xx, xy, yy on the plane of 3D Gaussians in the camera frame at depth PLANE_DEPTH.

    By the local affine approximation of the projection (EWA splatting, Zwicker et al. 2002) with the Jacobian J = [1 0
    -x; 0 1 -y] / depth. means: (n, 2) on the plane. log_scales: (n, 3), logarithms of the deviations along the axes.
    quaternions: (n, 4), wxyz.
    """
    rotation = rotation_matrices(quaternions)
    x, y = means[:, :1], means[:, 1:]
    # Rows of J R, scaled by the axes: (J R S)(J R S)^T is the projected covariance.
    row_x = (rotation[:, 0] - x * rotation[:, 2]) * log_scales.exp() / PLANE_DEPTH
    row_y = (rotation[:, 1] - y * rotation[:, 2]) * log_scales.exp() / PLANE_DEPTH
    return torch.stack([(row_x * row_x).sum(-1), (row_x * row_y).sum(-1), (row_y * row_y).sum(-1)], -1)


def covariance_of_ellipse(log_scales: Tensor, directions: Tensor) -> Tensor:
    """Return covariances (n, 3) as xx, xy, yy of ellipses: log_scales (n, 2), logarithms of the standard deviations;
    directions (n, 2) of the first axis, any length."""
    axis = functional.normalize(directions, dim=-1, eps=1e-12)
    variances = (2 * log_scales).exp()
    c, s = axis[:, 0], axis[:, 1]
    a, b = variances[:, 0], variances[:, 1]
    return torch.stack([a * c * c + b * s * s, (a - b) * c * s, a * s * s + b * c * c], -1)


def arcs_of_ellipse(arcs: Tensor, log_scales: Tensor, directions: Tensor) -> Tensor:
    """Convert arcs a (n, 2), in deviations along the axes of an ellipse, to arcs (n, 2) on the plane: R diag(s) a.

    R turns to the ellipse's axes, s are its deviations; the strength |a| = beta does not depend on its size.
    log_scales: (n, 2), logarithms of s. directions: (n, 2) of the first axis, any length.
    """
    axis = functional.normalize(directions, dim=-1, eps=1e-12)
    along, across = (arcs * log_scales.exp()).unbind(-1)
    return along[:, None] * axis + across[:, None] * torch.stack([-axis[:, 1], axis[:, 0]], -1)


def opacity_gain(arcs: Tensor, rings: Tensor) -> Tensor:
    """Return factors (n,) on opacities that make the picture differentiable in arcs (n, 2), in deviations, at zero.

    Rasterizers keep a profile's peak at its opacity: for an arc of strength beta = |arc| they subtract r0 beta from the
    profile's logarithm, and beta has a kink at zero. The factor replaces this beta by beta^2 / sqrt(beta^2 +
    ARC_SOFTNESS^2), which has none and soon equals beta. So the peak exceeds the opacity, by exp(0.03 r0) at most.
    rings: (n, 2), r0 and w.
    """
    squared = arcs.square().sum(-1)
    beta = squared.clamp(min=STRENGTH2_MIN).sqrt()
    return torch.exp(rings[:, 0] * (beta - squared * (squared + ARC_SOFTNESS**2).rsqrt()))


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """Convert quaternions (n, 4) wxyz, any length but zero, to rotation matrices (n, 3, 3)."""
    w, x, y, z = functional.normalize(quaternions, dim=-1, eps=1e-12).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def to_pixels(gaussians: PlaneGaussians, intrinsics: Tensor,
              pixel_grid: PixelGrid | None = None) -> tuple[Tensor, Tensor]:
    """Return centres (n, 2) px and covariances (n, 3) px^2 under intrinsics (3, 3), with the low-pass filter added.

    The low-pass filter is a variance added along both axes. pixel_grid: the grid at which the Gaussians were fitted;
    None for the default filter.
    """
    focal, centre = intrinsics.diagonal()[:2], intrinsics[:2, 2]
    fx, fy = focal
    stretch = torch.stack([fx * fx, fx * fy, fy * fy])
    variance = dilation(pixel_grid, math.sqrt(float(fx * fy)))
    low_pass = torch.tensor([variance, 0.0, variance], dtype=stretch.dtype, device=stretch.device)
    focal, centre, stretch, low_pass = (part.to(gaussians.means.device) for part in (focal, centre, stretch, low_pass))
    return gaussians.means * focal + centre, gaussians.covariances * stretch + low_pass


def arcs_to_pixels(arcs: Tensor, covariances: Tensor, intrinsics: Tensor) -> Tensor:
    """Return b (n, 2), px^-1, of the factor exp(b · d) on Gaussians in pixels, for arcs (n, 2) on the plane.

    An arc is the shift that the factor gives the mean of a Gaussian without a ring, covariance times b; so b solves a
    2x2 system, in double precision, since covariances of long thin Gaussians are nearly singular. covariances: (n, 3),
    px^2, from `to_pixels`: with the low-pass filter, so that the filter does not change the shift.
    """
    x, y = (arcs * intrinsics.diagonal()[:2].to(arcs.device)).double().unbind(-1)
    xx, xy, yy = covariances.double().unbind(-1)
    determinant = (xx * yy - xy * xy).clamp(min=1e-12)
    return (torch.stack([yy * x - xy * y, xx * y - xy * x], -1) / determinant[:, None]).to(arcs.dtype)
