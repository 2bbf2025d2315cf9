# SPDX-License-Identifier: GPL-3.0-or-later
"""The kernels for CPUs: numba with explicit SIMD, on all threads of torch.

From the bottom up: `compilation` and `threads` (machine code and the threads that run it), `buffers` (memory),
`vector` (16 lanes as a type), then the kernels, each with its mathematics in its module head: `spherical_harmonics`,
`ellipse`, `projection`, `binning`, `raster_forward`, `raster_backward`. `scene` runs them in order as one autograd
function. `flare` and `splats` do the same for 2D Gaussians. `deformation`, `hash_grid` and `placement` compute a
flare's Gaussians, `added_light` composites it, `transmittance` computes how much of its light the scene lets through.
"""
from __future__ import annotations

from .added_light import add_light
from .deformation import deform
from .hash_grid import GridLayout, interpolate_grid, sparse_adam_step
from .layers import over, upsample
from .loss import l1_ssim
from .optimiser import AdamStep, adam_steps
from .placement import COLUMNS as PLACED_COLUMNS
from .placement import place
from .scene import rasterize_scene
from .splats import splat
from .stepping import offer_steps
from .transmittance import mean_transmittances

__all__ = [
    "PLACED_COLUMNS", "AdamStep", "GridLayout", "adam_steps", "add_light", "deform", "interpolate_grid",
    "l1_ssim", "mean_transmittances", "offer_steps", "over", "place", "rasterize_scene", "sparse_adam_step", "splat",
    "upsample",
]  # fmt: skip
