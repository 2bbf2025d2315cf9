# SPDX-License-Identifier: GPL-3.0-or-later
"""The Gaussians that rasterizers are timed on: the same for all of them, from a seed.

A scene fills the part of a frustum (60 degrees across, 16:9) between the depths 2 and 10, in front of a camera
at the origin that looks along +z. Scales are log-normal about a size that falls with the square root of the
count, so that about 50 Gaussians blend at each pixel whatever the count. Flares are soft 2D Gaussians, each of
which covers 5 to 40 % of the picture with alpha above 1/255.
"""
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

TAN = math.tan(math.radians(30))


class Scene(NamedTuple):
    """Parameters of a scene: means (n, 3), log_scales (n, 3), quaternions (n, 4) of any length, opacity_logits (n,),
    sh (n, 16, 3)."""

    means: Tensor
    log_scales: Tensor
    quaternions: Tensor
    opacity_logits: Tensor
    sh: Tensor


class Flares(NamedTuple):
    """centres (n, 2) px, covariances (n, 3) xx xy yy px², opacities (n,), colours (n, 3)."""

    centres: Tensor
    covariances: Tensor
    opacities: Tensor
    colours: Tensor


def scene(n: int, seed: int = 0) -> Scene:
    """Return a scene of n Gaussians."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(2, 10, n)
    x = z * TAN * rng.uniform(-1.1, 1.1, n)
    y = z * TAN * 270 / 480 * rng.uniform(-1.15, 1.15, n)
    typical = np.log(0.042 * math.sqrt(10_000 / n) * z / 5)
    log_scales = typical[:, None] + rng.normal(0, 0.55, (n, 1)) + rng.normal(0, 0.45, (n, 3))
    quaternions = rng.normal(size=(n, 4))
    opacity_logits = rng.normal(-0.4, 1.8, n)
    sh = rng.normal(0, 0.1, (n, 16, 3))
    sh[:, 0] = rng.normal(0, 1, (n, 3))
    values = (np.stack([x, y, z], 1), log_scales, quaternions, opacity_logits, sh)
    return Scene(*(torch.tensor(value, dtype=torch.float32) for value in values))


def intrinsics(width: int, height: int) -> Tensor:
    """Return the matrix (3, 3) of the camera."""
    focal = width / (2 * TAN)
    return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def flares(n: int, width: int, height: int, seed: int = 1) -> Flares:
    """Return n flare Gaussians for a picture of this size, pixels."""
    rng = np.random.default_rng(seed)
    covered = np.exp(rng.uniform(math.log(0.05), math.log(0.4), n)) * width * height
    opacities = np.exp(rng.uniform(math.log(0.006), math.log(0.03), n))
    variance = covered / (math.pi * 2 * np.log(255 * opacities))  # alpha falls to 1/255 at the rim
    stretch = np.exp(rng.normal(0, 0.5, n))
    theta = rng.uniform(0, math.pi, n)
    c, s = np.cos(theta), np.sin(theta)
    a, b = variance * stretch, variance / stretch
    # 0.3 px² is the low-pass filter of 3DGS.
    covariances = np.stack([c * c * a + s * s * b + 0.3, c * s * (a - b), s * s * a + c * c * b + 0.3], 1)
    centres = np.stack([rng.uniform(0.1, 0.9, n) * width, rng.uniform(0.1, 0.9, n) * height], 1)
    values = (centres, covariances, opacities, rng.uniform(0, 1, (n, 3)))
    return Flares(*(torch.tensor(value, dtype=torch.float32) for value in values))
