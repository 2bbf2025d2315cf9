# SPDX-License-Identifier: GPL-3.0-or-later
"""The kernels for CPUs: numba with explicit SIMD, on all threads of torch.

From the bottom up: `compilation` and `threads` (machine code and the threads that run it), `buffers` (memory),
`vector` (16 lanes as a type), then the kernels, each with its mathematics in its module head: `spherical_harmonics`,
`projection`, `binning`, `raster_forward`, `raster_backward`. `scene` runs them in order as one autograd function.
`flare` and `splats` do the same for 2D Gaussians.
"""
from __future__ import annotations

from .layers import over, upsample
from .loss import l1_ssim
from .optimiser import AdamStep, adam_steps
from .scene import rasterize_scene
from .splats import splat
from .stepping import offer_steps

__all__ = ["AdamStep", "adam_steps", "l1_ssim", "offer_steps", "over", "rasterize_scene", "splat", "upsample"]
