# SPDX-License-Identifier: GPL-3.0-or-later
"""The photometric loss between a picture and its target: L1 and structural similarity.

SSIM (Wang et al. 2004) compares local means, variances and covariance under a Gaussian window:

    ssim = (2 mu_a mu_b + C1)(2 s_ab + C2) / ((mu_a² + mu_b² + C1)(s_a + s_b + C2))

with C1 = 0.01², C2 = 0.03² for values in 0..1, a window of 11 x 11 with sigma 1.5, zero padding, averaged
over pixels and channels, all as in 3DGS.
"""
from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from ..errors import SettingsError
from .kernels import fused_kernels

WINDOW = 11
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def l1_ssim(image: Tensor, target: Tensor, lam: float, *, kernels: Literal["auto", "torch"] = "auto") -> Tensor:
    """Return lam * mean|image - target| + (1 - lam) * (1 - SSIM(image, target)), a scalar.

    image, target: (h, w, 3), 0..1. Differentiable by the image; the target is a constant.
    lam: weight of L1 (the paper: 0.9; 3DGS: 0.8). Raises SettingsError for different sizes.
    """
    _check_shapes(image, target)
    cpu = fused_kernels(image) if kernels == "auto" else None
    if cpu is not None:
        return cpu.l1_ssim(image, target, lam)
    target = target.detach()
    return lam * (image - target).abs().mean() + (1 - lam) * (1 - ssim(image, target))


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Return the mean structural similarity of two (h, w, 3) pictures, a scalar, 1 for equal pictures."""
    _check_shapes(image, target)
    a, b = image.permute(2, 0, 1), target.permute(2, 0, 1)
    mu_a, mu_b, aa, bb, ab = _blur(torch.cat([a, b, a * a, b * b, a * b])).split(3)
    variances = aa - mu_a * mu_a + bb - mu_b * mu_b
    covariance = ab - mu_a * mu_b
    luminance = (2 * mu_a * mu_b + C1) / (mu_a * mu_a + mu_b * mu_b + C1)
    return (luminance * (2 * covariance + C2) / (variances + C2)).mean()


def window(like: Tensor) -> Tensor:
    """Return the (11,) weights of the window along one axis; they sum to 1."""
    x = torch.arange(WINDOW, dtype=like.dtype, device=like.device) - WINDOW // 2
    weights = torch.exp(-(x * x) / (2 * SIGMA * SIGMA))
    return weights / weights.sum()


def _blur(planes: Tensor) -> Tensor:
    """Blur (c, h, w) by the window, one axis at a time, with zero padding."""
    weights = window(planes)
    planes = torch.nn.functional.conv2d(planes[:, None], weights.view(1, 1, 1, -1), padding=(0, WINDOW // 2))
    return torch.nn.functional.conv2d(planes, weights.view(1, 1, -1, 1), padding=(WINDOW // 2, 0))[:, 0]


def _check_shapes(image: Tensor, target: Tensor) -> None:
    if image.shape != target.shape or image.ndim != 3 or image.shape[2] != 3:
        raise SettingsError(
            f"Picture and target must both be (h, w, 3), not {tuple(image.shape)} and {tuple(target.shape)}."
        )
