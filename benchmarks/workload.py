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

TAN_HALF_ANGLE = math.tan(math.radians(30))
"""Of the frustum's angle across."""


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


def make_scene(count: int, seed: int = 0) -> Scene:
    """Return random parameters of `count` scene Gaussians, with the distributions that the head of this file states."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(2, 10, count)
    x = z * TAN_HALF_ANGLE * rng.uniform(-1.1, 1.1, count)
    y = z * TAN_HALF_ANGLE * 270 / 480 * rng.uniform(-1.15, 1.15, count)
    mean_log_scale = np.log(0.042 * math.sqrt(10_000 / count) * z / 5)
    log_scales = mean_log_scale[:, None] + rng.normal(0, 0.55, (count, 1)) + rng.normal(0, 0.45, (count, 3))
    quaternions = rng.normal(size=(count, 4))
    opacity_logits = rng.normal(-0.4, 1.8, count)
    sh = rng.normal(0, 0.1, (count, 16, 3))
    sh[:, 0] = rng.normal(0, 1, (count, 3))
    values = (np.stack([x, y, z], 1), log_scales, quaternions, opacity_logits, sh)
    return Scene(*(torch.tensor(value, dtype=torch.float32) for value in values))


def intrinsics(width: int, height: int) -> Tensor:
    """Return the matrix (3, 3) of the camera."""
    focal = width / (2 * TAN_HALF_ANGLE)
    return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def make_flares(count: int, width: int, height: int, seed: int = 1) -> Flares:
    """Make `count` flare Gaussians for a picture of this size, pixels."""
    rng = np.random.default_rng(seed)
    covered_area = np.exp(rng.uniform(math.log(0.05), math.log(0.4), count)) * width * height
    opacities = np.exp(rng.uniform(math.log(0.006), math.log(0.03), count))
    # Alpha is 1/255 at the radius r with r² = 2 variance ln(255 opacity); the covered area is π r².
    variance = covered_area / (math.pi * 2 * np.log(255 * opacities))
    stretch = np.exp(rng.normal(0, 0.5, count))
    angle = rng.uniform(0, math.pi, count)
    cosine, sine = np.cos(angle), np.sin(angle)
    major, minor = variance * stretch, variance / stretch
    # 0.3 px² is the low-pass filter of 3DGS.
    xx = cosine * cosine * major + sine * sine * minor + 0.3
    yy = sine * sine * major + cosine * cosine * minor + 0.3
    covariances = np.stack([xx, cosine * sine * (major - minor), yy], 1)
    centres = np.stack([rng.uniform(0.1, 0.9, count) * width, rng.uniform(0.1, 0.9, count) * height], 1)
    values = (centres, covariances, opacities, rng.uniform(0, 1, (count, 3)))
    return Flares(*(torch.tensor(value, dtype=torch.float32) for value in values))
