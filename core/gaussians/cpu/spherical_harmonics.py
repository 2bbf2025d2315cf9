# SPDX-License-Identifier: GPL-3.0-or-later
"""Colours from spherical harmonics, 16 Gaussians at a time, and their derivatives; called by `projection`.

    colour_c = sum_k b_k(x, y, z) sh_kc + 1/2

with the basis b of `..spherical_harmonics`. Coefficients are transposed to 48 rows (k, c) of 16 Gaussians, one vector
per row (`load_transposed`). In the backward pass, with the gradient v_c of the colours:

    d sh_kc = b_k v_c        d direction = sum_c v_c slope_c,   slope_c = sum_k sh_kc grad b_k

The slopes are computed in the forward pass, while the coefficients, which dominate the memory traffic, are loaded.
"""
from __future__ import annotations

import numpy as np

from ...conventions.splatting import C0 as _C0
from ...conventions.splatting import C1 as _C1
from ...conventions.splatting import C2 as _C2
from ...conventions.splatting import C3 as _C3
from .compilation import inlined
from .vector import LANES, fma, load, load_rows, opaque, splat, store, store_rows, stream_rows, transpose

C0, C1 = np.float32(_C0), np.float32(_C1)
C20, C21, C22 = (np.float32(c) for c in _C2)
C30, C31, C32, C33, C34 = (np.float32(c) for c in _C3)
ROWS = 48
ZERO, HALF, TWO, THREE, FOUR, EIGHT = (np.float32(number) for number in (0, 0.5, 2, 3, 4, 8))


@inlined
def load_transposed(sh, first_gaussian, width, used_width, transposed):
    """Write the first used_width of the `width` numbers of 16 Gaussians, from row first_gaussian of sh (n, width) on,
    to `transposed`, one vector for each number."""
    opaque_one = opaque(1)  # opaque: the loop is not unrolled
    column = 0
    while column < used_width:
        if column + LANES <= width:
            rows = load_rows(sh, first_gaussian * width + column, width)
            store_rows(transposed, column * LANES, LANES, transpose(rows))
            column += LANES
        else:
            i = 0
            while i < LANES:
                transposed[column * LANES + i] = sh[(first_gaussian + i) * width + column]
                i += opaque_one
            column += opaque_one


@inlined
def store_transposed(transposed, first_gaussian, width, sh, keep_cached):
    """Invert `load_transposed`: write all `width` numbers of 16 Gaussians to sh (n, width), from row first_gaussian on.

    keep_cached: whether they are read soon; else they are written past the caches."""
    opaque_one = opaque(1)  # opaque: the loop is not unrolled
    column = 0
    while column < width:
        if column + LANES <= width:
            rows = load_rows(transposed, column * LANES, LANES)
            if width == ROWS and not keep_cached:  # rows of 48 numbers begin at cache lines, as `stream_rows` requires
                stream_rows(sh, first_gaussian * width + column, width, transpose(rows))
            else:
                store_rows(sh, first_gaussian * width + column, width, transpose(rows))
            column += LANES
        else:
            i = 0
            while i < LANES:
                sh[(first_gaussian + i) * width + column] = transposed[column * LANES + i]
                i += opaque_one
            column += opaque_one


@inlined
def _write_basis(degree, x, y, z, basis):
    """Write the basis functions up to this degree at unit directions, one vector each, to `basis`."""
    store(basis, 0, splat(C0))
    if degree >= 1:
        store_rows(basis, LANES, LANES, (y * -C1, z * C1, x * -C1))
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        store_rows(basis, 4 * LANES, LANES, (
            x * y * C20, y * z * -C20, (zz * TWO - xx - yy) * C21, x * z * -C20, (xx - yy) * C22
        ))  # fmt: skip
        if degree >= 3:
            four_zz_less_xx_yy = zz * FOUR - xx - yy
            store_rows(basis, 9 * LANES, LANES, (
                y * (xx * THREE - yy) * -C30, x * y * z * C31, y * four_zz_less_xx_yy * -C32,
                z * (zz * TWO - xx * THREE - yy * THREE) * C33,
                x * four_zz_less_xx_yy * -C32, z * (xx - yy) * C34, x * (xx - yy * THREE) * -C30,
            ))  # fmt: skip


@inlined
def colours(transposed, degree, x, y, z, basis):
    """Return the colours (r, g, b), not yet clamped at 0, along unit directions x, y, z.

    transposed: coefficients from `load_transposed`; degree: highest degree in use; basis: workspace of 16 vectors."""
    _write_basis(degree, x, y, z, basis)
    red, green, blue = splat(HALF), splat(HALF), splat(HALF)
    for k in range((degree + 1) * (degree + 1)):
        basis_value, index = load(basis, k * LANES), 3 * k * LANES
        red = fma(basis_value, load(transposed, index), red)
        green = fma(basis_value, load(transposed, index + LANES), green)
        blue = fma(basis_value, load(transposed, index + 2 * LANES), blue)
    return red, green, blue


@inlined
def coefficients_backward(degree, x, y, z, d_colours, basis, transposed):
    """Write the gradients of the coefficients to `transposed`, in the layout of `load_transposed`; zeros above the
    degree.

    d_colours: gradients of the colours along unit directions x, y, z; basis: workspace of 16 vectors."""
    _write_basis(degree, x, y, z, basis)
    num_coefficients = (degree + 1) * (degree + 1)
    for k in range(num_coefficients):
        basis_value = load(basis, k * LANES)
        by_channel = (basis_value * d_colours[0], basis_value * d_colours[1], basis_value * d_colours[2])
        store_rows(transposed, 3 * k * LANES, LANES, by_channel)
    for row in range(3 * num_coefficients, ROWS):
        store(transposed, row * LANES, splat(ZERO))


@inlined
def colour_slope(transposed, degree, x, y, z, channel):
    """Return the gradient of a channel's colour by the direction, sum_k sh_k grad b_k, at unit directions x, y, z; not
    yet projected on the sphere. transposed: coefficients from `load_transposed`."""
    rows, stride = transposed[channel * LANES :], 3 * LANES  # coefficient k is at row k * stride
    zero = splat(ZERO)
    dx, dy, dz = zero, zero, zero
    # h_k: coefficient k times a constant of grad b_k
    if degree >= 1:
        dx, dy, dz = load(rows, 3 * stride) * -C1, load(rows, stride) * -C1, load(rows, 2 * stride) * C1
    if degree >= 2:
        h4, h5, h7 = load(rows, 4 * stride) * C20, load(rows, 5 * stride) * -C20, load(rows, 7 * stride) * -C20
        h6, h8 = load(rows, 6 * stride) * (C21 * TWO), load(rows, 8 * stride) * (C22 * TWO)
        dx = dx + h4 * y + h7 * z + (h8 - h6) * x
        dy = dy + h4 * x + h5 * z - (h8 + h6) * y
        dz = dz + h5 * y + h7 * x + h6 * TWO * z
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        h9, h10 = load(rows, 9 * stride) * (C30 * -THREE), load(rows, 10 * stride) * C31
        h11, h13 = load(rows, 11 * stride) * -C32, load(rows, 13 * stride) * -C32
        h12 = load(rows, 12 * stride) * (C33 * THREE)
        h14, h15 = load(rows, 14 * stride) * C34, load(rows, 15 * stride) * (C30 * -THREE)
        two_xy, xx_less_yy = x * y * TWO, xx - yy
        h12_z = h12 * z * -TWO
        dx = dx + h9 * two_xy + h10 * y * z - h11 * two_xy + h12_z * x + h13 * (zz * FOUR - xx * THREE - yy)
        dx = dx + h14 * x * z * TWO + h15 * xx_less_yy
        dy = dy + h9 * xx_less_yy + h10 * x * z + h11 * (zz * FOUR - xx - yy * THREE) + h12_z * y
        dy = dy - h13 * two_xy - h14 * y * z * TWO - h15 * two_xy
        dz = dz + h10 * x * y + (h11 * y + h13 * x) * z * EIGHT + h12 * (zz * TWO - xx - yy) + h14 * xx_less_yy
    return dx, dy, dz
