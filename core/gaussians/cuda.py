# SPDX-License-Identifier: GPL-3.0-or-later
"""The kernels for NVIDIA GPUs: projection, colours and lists in torch, tiles by Warp, which needs neither a CUDA
toolkit nor a compiler (`pip install warp-lang`).

Not yet run on a GPU. The kernels pass the comparison with the definition on Warp's CPU device, and compile for
GPUs from compute capability 7.5 on; how fast they are there nobody has measured.
"""
from __future__ import annotations

from functools import partial

import torch

if not torch.cuda.is_available():
    raise ImportError("torch finds no NVIDIA GPU")

from . import tiled, warp_kernels

rasterize_scene = partial(tiled.rasterize_scene, warp_kernels.draw, warp_kernels.TILE)
splat = partial(tiled.splat, warp_kernels.draw, warp_kernels.TILE)
