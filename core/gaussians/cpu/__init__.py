# SPDX-License-Identifier: GPL-3.0-or-later
"""The kernels for CPUs: numba with explicit SIMD, on all threads of torch.

From the bottom up: `compilation` and `threads` (machine code, and who runs it), `buffers` (memory), `vector` (16
lanes as a type), then each kernel with its mathematics in its head: `spherical_harmonics`, `projection`,
`binning`, `raster_forward`, `raster_backward`; `scene` strings them together for autograd.
"""
from __future__ import annotations

from .layers import enlarged, over
from .loss import l1_ssim
from .optimiser import Step, adam_steps
from .scene import rasterize_scene
from .splats import splat
from .stepping import offered

__all__ = ["Step", "adam_steps", "enlarged", "l1_ssim", "offered", "over", "rasterize_scene", "splat"]
