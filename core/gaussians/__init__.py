# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussian splatting: rendering with gradients, on every machine.

`rasterization` renders 3D Gaussians, `splat` lays 2D ones on a picture; both run on the fastest kernels at
hand, and every kernel set gives the picture that `reference.py` defines. `SceneGaussians` is a scene to
optimise, `l1_ssim` and `Adam` what optimises it.
"""
from __future__ import annotations

import numpy as np
import torch

# Values fade through the denormal range all the time here, where arithmetic is up to 40 times slower.
# numpy measures its denormals when first asked, and warns if there are none: it is asked before.
for _kind in (np.float32, np.float64):
    np.finfo(_kind)
torch.set_flush_denormal(True)

from .layers import over  # noqa: E402
from .loss import l1_ssim, ssim  # noqa: E402
from .optimiser import Adam  # noqa: E402
from .rasterizer import rasterization, splat  # noqa: E402
from .rendering import Rendering, Splats  # noqa: E402
from .scene import SceneGaussians  # noqa: E402

__all__ = ["Adam", "Rendering", "SceneGaussians", "Splats", "l1_ssim", "over", "rasterization", "splat", "ssim"]
