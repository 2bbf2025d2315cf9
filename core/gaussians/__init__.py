# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussian splatting: differentiable rendering on every machine.

`rasterization` renders 3D Gaussians, `splat` rasterizes 2D ones; both use the fastest kernel set that is installed, and
every kernel set renders the picture that `reference.py` defines. `SceneGaussians` holds the parameters of a scene;
`l1_ssim` and `Adam` optimise them.
"""
from __future__ import annotations

import numpy as np
import torch

# Values often fade into the denormal range, where arithmetic is up to 40 times slower; denormals are flushed to zero.
# numpy measures its denormals at the first finfo and warns if there are none, so finfo is called before.
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
