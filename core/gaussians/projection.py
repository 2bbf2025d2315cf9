# SPDX-License-Identifier: GPL-3.0-or-later
"""Projects 3D Gaussians to 2D by EWA splatting (Zwicker et al. 2001; Kerbl et al. 2023, eq. 5, 6).

A Gaussian of rotation R and scales S has the covariance R S S^T R^T. In the picture of a camera with rotation W, with
the perspective map linearised at the mean (J), its covariance is T T^T with T = J W R S, a 2 x 3 matrix. `dilation` on
the diagonal is the low-pass filter of the pixel.
"""
from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

QUATERNION_MIN = 1e-8
"""Smallest norm that quaternions are divided by, so that a zero quaternion does not give NaN."""
FRUSTUM_MARGIN = 0.3
"""Distance outside the frame at which J is clamped, relative to tan(half field of view): further out the linear map
does not approximate the perspective one."""


class Projected(NamedTuple):
    """The m Gaussians beyond the near plane. indices (m,) into the n given; centres (m, 2) px; covariances
    (m, 3) xx, xy, yy in px², dilation included; depths (m,) camera z."""

    indices: Tensor
    centres: Tensor
    covariances: Tensor
    depths: Tensor


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """Return (n, 3, 3) rotations of (n, 4) quaternions w, x, y, z of any length."""
    w, x, y, z = (
        quaternions / torch.linalg.vector_norm(quaternions, dim=-1, keepdim=True).clamp(min=QUATERNION_MIN)
    ).unbind(-1)
    return torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        -1,
    ).reshape(-1, 3, 3)  # fmt: skip


def camera_position(world_to_camera: Tensor) -> Tensor:
    """Return (3,) world coordinates of the camera: -R^T t."""
    return -world_to_camera[:3, :3].T @ world_to_camera[:3, 3]


def frustum_limits(intrinsics: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Return lower and upper bounds (2,) to which (x/z, y/z) are clamped for the Jacobian J; without gradients."""
    focal, principal = intrinsics.detach().diagonal()[:2], intrinsics.detach()[:2, 2]
    size = torch.tensor([width, height], dtype=focal.dtype, device=focal.device)
    margin = FRUSTUM_MARGIN * size / (2 * focal)
    return -principal / focal - margin, (size - principal) / focal + margin


def project(
    means: Tensor, quats: Tensor, scales: Tensor, world_to_camera: Tensor, intrinsics: Tensor,
    width: int, height: int, near: float, dilation: float,
) -> Projected:  # fmt: skip
    """Project n Gaussians to ellipses on the picture by EWA splatting; differentiable by all tensors.

    means (n, 3), quats (n, 4), scales (n, 3); world_to_camera (4, 4); intrinsics (3, 3), without skew.

    near: camera depth up to which Gaussians are culled, world units; dilation: low-pass filter, px²."""
    rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
    positions = means @ rotation.T + translation
    index = torch.nonzero(positions[:, 2] > near)[:, 0]
    x, y, z = positions[index].unbind(-1)
    focal, principal = intrinsics.diagonal()[:2], intrinsics[:2, 2]

    slopes = torch.stack([x / z, y / z], -1)
    centres = slopes * focal + principal

    u = slopes.clamp(*frustum_limits(intrinsics, width, height))
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([focal[0] / z, zero, -focal[0] * u[:, 0] / z], -1),
            torch.stack([zero, focal[1] / z, -focal[1] * u[:, 1] / z], -1),
        ],
        -2,
    )
    t = jacobian @ rotation @ (rotation_matrices(quats[index]) * scales[index, None, :])
    a, b = t.unbind(-2)
    covariances = torch.stack([(a * a).sum(-1) + dilation, (a * b).sum(-1), (b * b).sum(-1) + dilation], -1)
    return Projected(index, centres, covariances, z)


def determinants(covariances: Tensor) -> Tensor:
    """Return (n,) determinants of (n, 3) covariances xx, xy, yy."""
    xx, xy, yy = covariances.unbind(-1)
    return xx * yy - xy * xy


def half_sizes(covariances: Tensor, radii: Tensor) -> Tensor:
    """Return half width and height (n, 2), px, of the bounding boxes of ellipses at Mahalanobis radii (n,)."""
    return radii[:, None] * covariances[:, ::2].clamp(min=0).sqrt()


def visible_radii(
    centres: Tensor, covariances: Tensor, radii: Tensor, width: int, height: int
) -> Tensor:
    """Return (n,) three standard deviations of the longer axis, px; 0 for Gaussians that are not visible.

    A Gaussian is visible if its bounding box at the Mahalanobis radius `radii` (n,) touches the frame. centres (n, 2)
    px; covariances (n, 3) xx, xy, yy, px²."""
    half = half_sizes(covariances, radii)
    frame = torch.tensor([width, height], dtype=centres.dtype, device=centres.device)
    inside = ((centres + half > 0) & (centres - half < frame)).all(-1) & (radii > 0)
    xx, xy, yy = covariances.unbind(-1)
    largest = (xx + yy) / 2 + (((xx - yy) / 2) ** 2 + xy * xy).sqrt()
    return 3 * largest.sqrt() * inside
