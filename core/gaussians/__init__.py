# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussian splatting: rendering with gradients, on every machine.

`rasterization` renders 3D Gaussians, `splat` lays 2D ones on a picture; both run on the fastest kernels at
hand, and every kernel set gives the picture that `reference.py` defines.
"""
from __future__ import annotations

import torch

from .rasterizer import rasterization, splat
from .rendering import Rendering, Splats

# Values fade through the denormal range all the time here, where arithmetic is up to 40 times slower.
torch.set_flush_denormal(True)

__all__ = ["Rendering", "Splats", "rasterization", "splat"]
