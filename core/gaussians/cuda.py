# SPDX-License-Identifier: GPL-3.0-or-later
"""The kernel set for NVIDIA GPUs, by Warp (`pip install warp-lang`), which needs neither a CUDA toolkit nor a compiler:
`warp_scene` for scenes, `tiled` with `warp_kernels` for 2D Gaussians."""
from __future__ import annotations

from functools import partial

import torch

if not torch.cuda.is_available():
    raise ImportError("torch finds no NVIDIA GPU")

from . import tiled, warp_kernels, warp_scene

rasterize_scene = warp_scene.rasterize_scene
splat = partial(tiled.splat, warp_kernels.draw, warp_kernels.TILE)
