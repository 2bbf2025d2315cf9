# SPDX-License-Identifier: GPL-3.0-or-later
"""The kernels for CPUs: numba with explicit SIMD, on all threads of torch.

From the bottom up: `compilation` and `threads` (machine code, and who runs it), `buffers` (memory), `vector` (16
lanes as a type), then each kernel with its mathematics in its head: `spherical_harmonics`, `projection`,
`binning`, `raster_forward`, `raster_backward`; `scene` strings them together for autograd.
"""
from __future__ import annotations

from .scene import rasterize_scene
from .splats import splat

__all__ = ["rasterize_scene", "splat"]


def l1_ssim(image, target, lam):  # noqa
    from ..loss import l1_ssim as plain
    return plain(image, target, lam, kernels="torch")


def adam_step(*a, **k):  # noqa
    from ..optimiser import adam_step as plain
    return plain(*a, **k)
