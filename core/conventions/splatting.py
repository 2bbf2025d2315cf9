# SPDX-License-Identifier: GPL-3.0-or-later
"""Constants of splatting, shared by torch's kernels and the numpy renderer so that both draw the same picture."""
from __future__ import annotations

ALPHA_MIN = 1 / 255
"""Blended contributions fainter than this are skipped, as in 3DGS."""
OPACITY_MAX = 0.99
"""Opacity is clamped here before blending, so that no Gaussian hides all behind it (and 1 - alpha > 0)."""
PROFILE_MIN = 1 / 4096
"""Added contributions are skipped where the profile is below this share of its own peak. Relative to
the peak, so that the extent of a Gaussian (4.08 sigma) depends on neither its opacity nor its colour."""

# Real spherical harmonics to degree 3, with the signs and order of 3DGS.
C0 = 0.28209479177387814  # 1 / (2 sqrt(pi))
C1 = 0.4886025119029199  # sqrt(3) / (2 sqrt(pi))
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
