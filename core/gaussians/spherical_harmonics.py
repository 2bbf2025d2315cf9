# SPDX-License-Identifier: GPL-3.0-or-later
"""Real spherical harmonics up to degree 3, for colour as a function of the viewing direction.

The basis, its signs and its order are those of 3DGS (and of its PLY files): for each degree l the orders
m = -l..l, Condon-Shortley phase included. A colour is max(sum_k basis_k(direction) sh_k + 1/2, 0).
"""
from __future__ import annotations

import torch
from torch import Tensor

from ..conventions.splatting import C0, C1, C2, C3
from ..errors import SettingsError

MAX_DEGREE = 3


def degree_of(coefficients: int) -> int:
    """Return the degree of a set of 1, 4, 9 or 16 coefficients.

    Raises SettingsError for any other count.
    """
    degree = round(coefficients**0.5) - 1
    if (degree + 1) ** 2 != coefficients or not 0 <= degree <= MAX_DEGREE:
        raise SettingsError(
            f"Spherical harmonics come as 1, 4, 9 or 16 coefficients, not {coefficients}; check sh's shape."
        )
    return degree


def basis(directions: Tensor, degree: int) -> Tensor:
    """Return the (n, (degree + 1)²) basis functions at (n, 3) unit directions."""
    x, y, z = directions.unbind(-1)
    functions = [torch.full_like(x, C0)]
    if degree >= 1:
        functions += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        functions += [
            C2[0] * x * y,
            -C2[0] * y * z,
            C2[1] * (2 * zz - xx - yy),
            -C2[0] * x * z,
            C2[2] * (xx - yy),
        ]
    if degree >= 3:
        functions += [
            -C3[0] * y * (3 * xx - yy),
            C3[1] * x * y * z,
            -C3[2] * y * (4 * zz - xx - yy),
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            -C3[2] * x * (4 * zz - xx - yy),
            C3[4] * z * (xx - yy),
            -C3[0] * x * (xx - 3 * yy),
        ]
    return torch.stack(functions, -1)


def colours(offsets: Tensor, sh: Tensor, degree: int) -> Tensor:
    """Return colours (n, 3) >= 0 of Gaussians seen along `offsets` (n, 3), camera position to mean, of any length.

    sh: (n, k, 3) with k >= (degree + 1)²; only that many are used (Kerbl et al. 2023, section 5.1).
    """
    directions = torch.nn.functional.normalize(offsets, dim=-1)
    functions = basis(directions, degree)
    return ((functions[:, :, None] * sh[:, : functions.shape[1]]).sum(1) + 0.5).clamp(min=0)


def dc_from_colour(colour: Tensor) -> Tensor:
    """Return the degree 0 coefficients of a colour (any shape) that is the same in all directions."""
    return (colour - 0.5) / C0
