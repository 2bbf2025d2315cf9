# SPDX-License-Identifier: GPL-3.0-or-later
"""Colour by direction, 16 Gaussians at a time, and its derivatives.

    colour_c = sum_k b_k(x, y, z) sh_kc + 1/2

with the basis b of `..spherical_harmonics`. Coefficients come turned: 48 rows (k, c) of 16 Gaussians each, one
vector a row (`gather`). Backward, with the gradient v_c of the colours:

    d sh_kc = b_k v_c        d direction = sum_k h_k grad b_k,   h_k = sum_c sh_kc v_c
"""
from __future__ import annotations

import numpy as np

from ..spherical_harmonics import C0 as _C0
from ..spherical_harmonics import C1 as _C1
from ..spherical_harmonics import C2 as _C2
from ..spherical_harmonics import C3 as _C3
from .compilation import inlined
from .vector import LANES, fma, load, load_rows, splat, store, store_rows, transpose

C0, C1 = np.float32(_C0), np.float32(_C1)
C20, C21, C22 = (np.float32(c) for c in _C2)
C30, C31, C32, C33, C34 = (np.float32(c) for c in _C3)
ROWS = 48
TWO, THREE, FOUR = np.float32(2), np.float32(3), np.float32(4)


@inlined
def gather(sh, first, width, used, turned):  # type: ignore[no-untyped-def]
    """Turns `used` of the `width` numbers of 16 Gaussians, from row `first` of sh (n, width) on."""
    for column in range(0, used, LANES):
        at = first * width + column
        if column + LANES <= width:
            store_rows(turned, column * LANES, LANES, transpose(load_rows(sh, at, width)))
        else:
            for j in range(column, used):
                for i in range(LANES):
                    turned[j * LANES + i] = sh[(first + i) * width + j]


@inlined
def scatter(turned, first, width, sh):  # type: ignore[no-untyped-def]
    """The inverse: writes all `width` numbers of 16 Gaussians."""
    for column in range(0, width, LANES):
        at = first * width + column
        if column + LANES <= width:
            store_rows(sh, at, width, transpose(load_rows(turned, column * LANES, LANES)))
        else:
            for j in range(column, width):
                for i in range(LANES):
                    sh[(first + i) * width + j] = turned[j * LANES + i]


@inlined
def _add(turned, k, b, colour):  # type: ignore[no-untyped-def]
    """colour + b sh_k."""
    at = 3 * k * LANES
    return (
        fma(b, load(turned, at), colour[0]),
        fma(b, load(turned, at + LANES), colour[1]),
        fma(b, load(turned, at + 2 * LANES), colour[2]),
    )


@inlined
def colours(turned, degree, x, y, z):  # type: ignore[no-untyped-def]
    """The colours (r, g, b), not yet cut off at 0, along unit directions."""
    half = splat(np.float32(0.5))
    c = _add(turned, 0, splat(C0), (half, half, half))
    if degree >= 1:
        c = _add(turned, 1, y * -C1, c)
        c = _add(turned, 2, z * C1, c)
        c = _add(turned, 3, x * -C1, c)
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        c = _add(turned, 4, x * y * C20, c)
        c = _add(turned, 5, y * z * -C20, c)
        c = _add(turned, 6, (zz * TWO - xx - yy) * C21, c)
        c = _add(turned, 7, x * z * -C20, c)
        c = _add(turned, 8, (xx - yy) * C22, c)
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        c = _add(turned, 9, y * (xx * THREE - yy) * -C30, c)
        c = _add(turned, 10, x * y * z * C31, c)
        c = _add(turned, 11, y * (zz * FOUR - xx - yy) * -C32, c)
        c = _add(turned, 12, z * (zz * TWO - xx * THREE - yy * THREE) * C33, c)
        c = _add(turned, 13, x * (zz * FOUR - xx - yy) * -C32, c)
        c = _add(turned, 14, z * (xx - yy) * C34, c)
        c = _add(turned, 15, x * (xx - yy * THREE) * -C30, c)
    return c


@inlined
def _share(turned, out, k, b, v):  # type: ignore[no-untyped-def]
    """Writes d sh_k and returns h_k."""
    at = 3 * k * LANES
    store(out, at, b * v[0])
    store(out, at + LANES, b * v[1])
    store(out, at + 2 * LANES, b * v[2])
    h = fma(load(turned, at + LANES), v[1], load(turned, at) * v[0])
    return fma(load(turned, at + 2 * LANES), v[2], h)


@inlined
def colours_backward(turned, degree, x, y, z, v, out):  # type: ignore[no-untyped-def]
    """Writes the gradient of the coefficients to out and returns that of the unit directions."""
    zero = splat(np.float32(0))
    dx, dy, dz = zero, zero, zero
    _share(turned, out, 0, splat(C0), v)
    for row in range(3 * (degree + 1) * (degree + 1), ROWS):
        store(out, row * LANES, zero)
    if degree >= 1:
        dy = dy - _share(turned, out, 1, y * -C1, v) * C1
        dz = dz + _share(turned, out, 2, z * C1, v) * C1
        dx = dx - _share(turned, out, 3, x * -C1, v) * C1
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        h = _share(turned, out, 4, x * y * C20, v) * C20
        dx, dy = fma(h, y, dx), fma(h, x, dy)
        h = _share(turned, out, 5, y * z * -C20, v) * -C20
        dy, dz = fma(h, z, dy), fma(h, y, dz)
        h = _share(turned, out, 6, (zz * TWO - xx - yy) * C21, v) * (C21 * TWO)
        dx, dy, dz = dx - h * x, dy - h * y, fma(h * TWO, z, dz)
        h = _share(turned, out, 7, x * z * -C20, v) * -C20
        dx, dz = fma(h, z, dx), fma(h, x, dz)
        h = _share(turned, out, 8, (xx - yy) * C22, v) * (C22 * TWO)
        dx, dy = fma(h, x, dx), dy - h * y
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        h = _share(turned, out, 9, y * (xx * THREE - yy) * -C30, v) * (-C30 * THREE)
        dx, dy = fma(h * TWO, x * y, dx), fma(h, xx - yy, dy)
        h = _share(turned, out, 10, x * y * z * C31, v) * C31
        dx, dy, dz = fma(h, y * z, dx), fma(h, x * z, dy), fma(h, x * y, dz)
        h = _share(turned, out, 11, y * (zz * FOUR - xx - yy) * -C32, v) * -C32
        dx, dy, dz = dx - h * TWO * x * y, fma(h, zz * FOUR - xx - yy * THREE, dy), fma(h * np.float32(8), y * z, dz)
        h = _share(turned, out, 12, z * (zz * TWO - xx * THREE - yy * THREE) * C33, v) * (C33 * THREE)
        dx, dy, dz = dx - h * TWO * x * z, dy - h * TWO * y * z, fma(h, zz * TWO - xx - yy, dz)
        h = _share(turned, out, 13, x * (zz * FOUR - xx - yy) * -C32, v) * -C32
        dx, dy, dz = fma(h, zz * FOUR - xx * THREE - yy, dx), dy - h * TWO * x * y, fma(h * np.float32(8), x * z, dz)
        h = _share(turned, out, 14, z * (xx - yy) * C34, v) * C34
        dx, dy, dz = fma(h * TWO, x * z, dx), dy - h * TWO * y * z, fma(h, xx - yy, dz)
        h = _share(turned, out, 15, x * (xx - yy * THREE) * -C30, v) * (-C30 * THREE)
        dx, dy = fma(h, xx - yy, dx), dy - h * TWO * x * y
    return dx, dy, dz
