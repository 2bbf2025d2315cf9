# SPDX-License-Identifier: GPL-3.0-or-later
"""The kernel set for NVIDIA GPUs: projection, colours and tile lists in torch, tiles by Warp (`pip install warp-lang`),
which needs neither a CUDA toolkit nor a compiler.

Small pictures spend their time in torch's calls, so the CPU kernels are faster there (docs/results/rasterizer.md).
"""
from __future__ import annotations

from functools import partial

import torch

if not torch.cuda.is_available():
    raise ImportError("torch finds no NVIDIA GPU")

from . import tiled, warp_kernels

rasterize_scene = partial(tiled.rasterize_scene, warp_kernels.draw, warp_kernels.TILE)
splat = partial(tiled.splat, warp_kernels.draw, warp_kernels.TILE)
