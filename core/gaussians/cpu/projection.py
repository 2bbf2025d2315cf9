# SPDX-License-Identifier: GPL-3.0-or-later
"""Projects 3D Gaussians to records of 64 bytes, and their gradients back; 16 Gaussians at a time. Called by `scene`.

Forward (the definition is `..projection`): p = R m + t; with s = (p_x, p_y) / p_z, u = s held within the
frustum's margin, and V = R Q the Gaussian's axes seen by the camera, the rows of T = J R Q S are

    a = f_x / p_z (V_0 - u_x V_2) S,    b = f_y / p_z (V_1 - u_y V_2) S        covariance = T T^T + dilation I

Its determinant is |a x b|² + dilation (a² + b²) + dilation²: a sum of squares, without the cancellation that
xx yy - xy² suffers for needles. For the same reason a record does not hold the conic but its square completed:

    q / (-2 ln 2) = A (d_x + k d_y)² + D d_y²,   k = -xy / yy,  A = h yy / det,  D = h / yy,  h = -1 / (2 ln 2)

so alpha = opacity 2^(A u² + D d_y²), u = d_x + k d_y. From one pixel row to the next the exponent's second
difference is 2 C with C = A k² + D. The rasterizer's recurrence uses `step` = 2^(2 C) - 1 and `run` = sqrt(-40 / C),
the number of rows over which e falls from its peak to 2^-40.

With `raw`, scales are logarithms and opacities logits, the form in which they are optimised.

In the backward pass the rasterizer provides moments of g = dL / d ln alpha over the pixels: sums of g, g u, g d_y,
g u², g u d_y, g d_y². They give the gradients of centre, covariance and opacity (`_gradients_from_moments`). The
gradients of colour and depth are sums themselves.

Arguments, all flat:

    means, quats, scales, opacities   see `rasterization`; with `raw`, logarithms and logits
    sh, sh_width     coefficients, and how many numbers of them a Gaussian has
    degree           of the harmonics that are used
    camera           from `pack_camera`
    width, height    size of the picture, px
    records          result, see `layout`
    centres, radii   results: (n 2) px; 3 sigma of the longer axis, px
    depths           result: infinite for a Gaussian that is not drawn
    max_tiles        result: upper bounds on the numbers of tiles
    small_tiles, small_rows        results of `small_footprints`: first tiles, and packed rows
    first_slots, chunk_max_tiles   results: exclusive sums of max_tiles within chunks, and their sums by chunk
    colour_slopes    result: gradients of the colours by the means, SLOPES vectors for each block of 16; empty if no
                     gradients are needed
"""
from __future__ import annotations

import math

import numpy as np

from .. import rendering
from ..projection import FRUSTUM_MARGIN
from . import spherical_harmonics as harmonics
from .binning import exclusive_sum, small_footprints
from .compilation import inlined, kernel
from .layout import (
    ALPHA_MIN,
    BLUE,
    CHUNK,
    G_BLUE,
    G_DEPTH,
    G_GREEN,
    G_RED,
    G_U,
    G_UU,
    G_UY,
    G_Y,
    G_YY,
    GREEN,
    HALF,
    ONE,
    OPACITY_MAX,
    RECORD,
    RED,
    TILE_SHIFT_X,
    TILE_SHIFT_Y,
    TWO,
    ZERO,
    G,
)
from .optimiser import step_array, unpack_constants
from .vector import (
    LANES,
    any_of,
    atomic_increment,
    deinterleave,
    exp,
    exp2m1,
    fma,
    interleave,
    lane_index,
    load,
    load_rows,
    load_scalar,
    log2,
    maximum,
    minimum,
    opaque,
    sigmoid,
    splat,
    sqrt,
    store,
    store_rows,
    to_ints,
    transpose,
    where,
)

# Offsets in the packed camera: rotation 0..8, translation 9..11, then
FX, FY, CX, CY, LOW_X, HIGH_X, LOW_Y, HIGH_Y, POSITION, NEAR, DILATION = 12, 13, 14, 15, 16, 17, 18, 19, 20, 23, 24
CAMERA = 25
# Sums over Gaussians for the camera's gradient: rotation 0..8, translation 9..11, fx fy cx cy, then
POSITION_SUM, CAMERA_SUMS = 16, 32
SLOPES = 9
"""Vectors of colour slopes for a block of 16 Gaussians: 3 colours times 3 axes."""

TRANSPOSED = harmonics.ROWS * LANES
SQUARE = LANES * LANES
SCRATCH = TRANSPOSED + SQUARE + CAMERA_SUMS * LANES
CHUNK_CAPACITY = CHUNK + LANES
"""Most Gaussians of a chunk, with the remainder of the last one."""
STEP_SCRATCH = SCRATCH + CHUNK_CAPACITY * (11 + harmonics.ROWS)
"""Scratch with a chunk's gradients: 3 + 4 + 3 + 1 numbers of mean, quaternion, scale, opacity, and the harmonics."""

H = np.float32(-0.5 / math.log(2))
TWO_LN2 = np.float32(2 * math.log(2))
ALPHA_MIN_INVERSE = np.float32(1 / rendering.ALPHA_MIN)
MARGIN = np.float32(1e-4)
"""Added to the reach, in powers of two, so that rounding loses no pixel at the rim, where alpha is tested again."""
NORM2_MIN = np.float32(1e-16)
"""Smallest squared length of a quaternion: the square of `..projection.QUATERNION_MIN`."""
MAX_INVERSE_NORM = np.float32(1e8)
"""Inverse length of the shortest quaternion that is normalised, the inverse root of NORM2_MIN."""
TINY = np.float32(1e-24)
"""Smallest squared distance from the camera; its inverse root is finite."""
MAX_DETERMINANT, INFINITY = np.float32(1e30), np.float32(np.inf)
RUN_LOG2_RANGE, RUN_MAX = np.float32(40), np.float32(32)
"""Bounds of a run of the recurrence in powers of two and in rows (see `raster_forward`), since rounding accumulates."""


@kernel
def pack_camera(world_to_camera, intrinsics, width, height, near, dilation, camera):
    """Write the packed camera (CAMERA,), at the offsets above, from the flat matrices (4, 4) and (3, 3).

    It includes the camera's position -R^T t and the bounds of x/z and y/z for J. near: smallest depth that is drawn;
    dilation: px², added to the variances."""
    for i in range(3):
        position = 0.0
        for j in range(3):
            camera[3 * i + j] = world_to_camera[4 * i + j]
            position -= np.float64(world_to_camera[4 * j + i]) * np.float64(world_to_camera[4 * j + 3])
        camera[9 + i] = world_to_camera[4 * i + 3]
        camera[POSITION + i] = position
    camera[NEAR], camera[DILATION] = near, dilation
    for axis in range(2):
        focal, principal = np.float64(intrinsics[4 * axis]), np.float64(intrinsics[3 * axis + 2])
        size = height if axis else width
        margin = FRUSTUM_MARGIN * size / (2 * focal)
        camera[FX + axis], camera[CX + axis] = focal, principal
        camera[LOW_X + 2 * axis] = -principal / focal - margin
        camera[HIGH_X + 2 * axis] = (size - principal) / focal + margin


@inlined
def _dot(a, b):
    return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2]))


@inlined
def _scale(s, a):
    return a[0] * s, a[1] * s, a[2] * s


@inlined
def _add_scaled(a, s, b):
    """Return a + s b."""
    return fma(s, b[0], a[0]), fma(s, b[1], a[1]), fma(s, b[2], a[2])


@inlined
def _rotation(w, x, y, z):
    """Return the rows of the rotation matrix of a unit quaternion w, x, y, z."""
    x2, y2, z2 = x * TWO, y * TWO, z * TWO
    xx, yy, zz = x * x2, y * y2, z * z2
    xy, xz, yz = x * y2, x * z2, y * z2
    wx, wy, wz = w * x2, w * y2, w * z2
    return (
        (ONE - (yy + zz), xy - wz, xz + wy),
        (xy + wz, ONE - (xx + zz), yz - wx),
        (xz - wy, yz + wx, ONE - (xx + yy)),
    )


@inlined
def _rotation_backward(w, x, y, z, g):
    """Return the gradient by the unit quaternion w, x, y, z from g, the gradient by the rows of its rotation matrix."""
    # Sums and differences of mirrored elements.
    s01, s02, s12 = g[0][1] + g[1][0], g[0][2] + g[2][0], g[1][2] + g[2][1]
    d10, d02, d21 = g[1][0] - g[0][1], g[0][2] - g[2][0], g[2][1] - g[1][2]
    return (
        (x * d21 + y * d02 + z * d10) * TWO,
        (y * s01 + z * s02 + w * d21 - x * TWO * (g[1][1] + g[2][2])) * TWO,
        (x * s01 + z * s12 + w * d02 - y * TWO * (g[0][0] + g[2][2])) * TWO,
        (x * s02 + y * s12 + w * d10 - z * TWO * (g[0][0] + g[1][1])) * TWO,
    )


@inlined
def _normalise(q):
    """Return the quaternion at length 1, and the inverse of its length; zero stays zero."""
    inverse = ONE / sqrt(maximum(fma(q[0], q[0], _dot((q[1], q[2], q[3]), (q[1], q[2], q[3]))), NORM2_MIN))
    return (q[0] * inverse, q[1] * inverse, q[2] * inverse, q[3] * inverse), inverse


@inlined
def _to_camera(camera, mean):
    """Return the camera coordinates of points (x, y, z)."""
    x, y, z = mean
    return (
        fma(x, camera[0], fma(y, camera[1], fma(z, camera[2], splat(camera[9])))),
        fma(x, camera[3], fma(y, camera[4], fma(z, camera[5], splat(camera[10])))),
        fma(x, camera[6], fma(y, camera[7], fma(z, camera[8], splat(camera[11])))),
    )


@inlined
def _rotate_to_camera(camera, rows):
    """Return the rows of R Q."""
    q0, q1, q2 = rows
    return (
        _add_scaled(_add_scaled(_scale(camera[0], q0), camera[1], q1), camera[2], q2),
        _add_scaled(_add_scaled(_scale(camera[3], q0), camera[4], q1), camera[5], q2),
        _add_scaled(_add_scaled(_scale(camera[6], q0), camera[7], q1), camera[8], q2),
    )


@inlined
def _rotate_to_world(camera, rows):
    """Return the rows of R^T G, the gradient of Q from G, that of R Q."""
    g0, g1, g2 = rows
    return (
        _add_scaled(_add_scaled(_scale(camera[0], g0), camera[3], g1), camera[6], g2),
        _add_scaled(_add_scaled(_scale(camera[1], g0), camera[4], g1), camera[7], g2),
        _add_scaled(_add_scaled(_scale(camera[2], g0), camera[5], g1), camera[8], g2),
    )


@inlined
def _multiply_elements(a, s):
    return a[0] * s[0], a[1] * s[1], a[2] * s[2]


@inlined
def _image_axes(camera, v, scales, slopes, inverse_z):
    """Return the rows a and b of T, and the clamped slopes u_x, u_y at which J is taken; v: rows of V."""
    ux = minimum(maximum(slopes[0], camera[LOW_X]), camera[HIGH_X])
    uy = minimum(maximum(slopes[1], camera[LOW_Y]), camera[HIGH_Y])
    a = _scale(inverse_z * camera[FX], _multiply_elements(_add_scaled(v[0], -ux, v[2]), scales))
    b = _scale(inverse_z * camera[FY], _multiply_elements(_add_scaled(v[1], -uy, v[2]), scales))
    return a, b, ux, uy


@inlined
def _covariance(a, b, dilation):
    """Return xx, xy, yy and the determinant of the covariance, from the rows a and b of T; see the module head."""
    aa, bb, ab = _dot(a, a), _dot(b, b), _dot(a, b)
    n = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    determinant = _dot(n, n) + (aa + bb + dilation) * dilation
    return aa + dilation, ab, bb + dilation, determinant


@inlined
def _direction(mean, camera):
    """Return unit vectors from the camera to the means, and the inverse distances."""
    x, y, z = mean[0] - camera[POSITION], mean[1] - camera[POSITION + 1], mean[2] - camera[POSITION + 2]
    inverse = ONE / sqrt(maximum(_dot((x, y, z), (x, y, z)), TINY))
    return _scale(inverse, (x, y, z)), inverse


@inlined
def _load3(array, first):
    return deinterleave((load(array, 3 * first), load(array, 3 * first + 16), load(array, 3 * first + 32)))


@inlined
def _load4(array, first):
    at = 4 * first
    return deinterleave((load(array, at), load(array, at + 16), load(array, at + 32), load(array, at + 48)))


@inlined
def _store3(array, first, values):
    store_rows(array, 3 * first, LANES, interleave(values))


@inlined
def _store4(array, first, values):
    store_rows(array, 4 * first, LANES, interleave(values))


@inlined
def _load_scales(scales, first, raw):
    s = _load3(scales, first)
    return (exp(s[0]), exp(s[1]), exp(s[2])) if raw else s


@inlined
def _load_opacities(opacities, first, raw):
    o = load(opacities, first)
    return sigmoid(o) if raw else o


@inlined
def _tiles_bound(x, y, half_x, half_y, is_visible, width, height):
    """Return the number of tiles that the box around each Gaussian touches; 0 where `is_visible` is false."""
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    first_column = to_ints(minimum(maximum(x - half_x, ZERO), right)) >> TILE_SHIFT_X
    last_column = to_ints(minimum(maximum(x + half_x, ZERO), right)) >> TILE_SHIFT_X
    first_row = to_ints(minimum(maximum(y - half_y, ZERO), bottom)) >> TILE_SHIFT_Y
    last_row = to_ints(minimum(maximum(y + half_y, ZERO), bottom)) >> TILE_SHIFT_Y
    return where(is_visible, (last_column - first_column + 1) * (last_row - first_row + 1), 0)


@inlined
def _project_block(
    means, quats, scales, opacities, sh, sh_width, degree, raw, camera, width, height, first, transposed, basis,
    records, centres, radii, depths, max_tiles, small_tiles, small_rows, colour_slopes,
):  # fmt: skip
    """Project the 16 Gaussians from `first` on; colour_slopes: of this block. transposed, basis: workspaces of
    TRANSPOSED and SQUARE numbers. The module head lists the others."""
    mean = _load3(means, first)
    px, py, pz = _to_camera(camera, mean)
    is_in_front = pz > camera[NEAR]
    zero = splat(ZERO)
    inverse_z = ONE / where(is_in_front, pz, ONE)
    slopes = (px * inverse_z, py * inverse_z)
    x = where(is_in_front, fma(slopes[0], camera[FX], splat(camera[CX])), ZERO)
    y = where(is_in_front, fma(slopes[1], camera[FY], splat(camera[CY])), ZERO)
    _store2(centres, first, x, y)

    (qw, qx, qy, qz), _ = _normalise(_load4(quats, first))
    v = _rotate_to_camera(camera, _rotation(qw, qx, qy, qz))
    a, b, _, _ = _image_axes(camera, v, _load_scales(scales, first, raw), slopes, inverse_z)
    xx, xy, yy, determinant = _covariance(a, b, camera[DILATION])

    opacity = minimum(splat(OPACITY_MAX), _load_opacities(opacities, first, raw))  # NaN, as second, stays NaN
    reach = log2(maximum(opacity, ALPHA_MIN) * ALPHA_MIN_INVERSE)  # half the squared radius, over ln 2
    radius2 = reach * TWO_LN2
    half_x, half_y = sqrt(radius2 * xx), sqrt(radius2 * yy)
    is_drawable = is_in_front & (determinant > ZERO) & (determinant < MAX_DETERMINANT) & (opacity >= ALPHA_MIN)
    is_in_frame = (x + half_x > ZERO) & (x - half_x < np.float32(width))
    is_in_frame = is_in_frame & (y + half_y > ZERO) & (y - half_y < np.float32(height))
    is_visible = is_drawable & is_in_frame & (yy > ZERO)
    half_difference = (xx - yy) * HALF
    largest_variance = (xx + yy) * HALF + sqrt(fma(half_difference, half_difference, xy * xy))
    store(radii, first, where(is_visible & (radius2 > ZERO), sqrt(largest_variance) * np.float32(3), ZERO))

    store(depths, first, where(is_visible, pz, INFINITY))
    inverse_y = ONE / where(is_visible, yy, ONE)
    k = -xy * inverse_y
    major = yy * H / where(is_visible, determinant, ONE)
    minor = inverse_y * H
    curvature = fma(major * k, k, minor)
    # Half a pixel wider than `binning` lists, so that rounding cannot make the bound too low.
    store(max_tiles, first, _tiles_bound(x, y, half_x + HALF, half_y + HALF, is_visible, width, height))
    first_tile, packed_rows = small_footprints(
        x, y, half_x, half_y, major, k, minor, -(reach + MARGIN), is_visible, width, height
    )
    store(small_tiles, first, first_tile)
    store(small_rows, first, packed_rows)

    red, green, blue = _block_colours(
        sh, sh_width, degree, first, mean, camera, any_of(is_visible), transposed, basis, colour_slopes
    )
    rows = transpose((
        x, y, major, k, minor, opacity, exp2m1(curvature * TWO), minimum(sqrt(RUN_LOG2_RANGE / -curvature), RUN_MAX),
        maximum(red, ZERO), maximum(green, ZERO), maximum(blue, ZERO), pz,
        -(reach + MARGIN), half_x, half_y, zero,
    ))  # fmt: skip
    store_rows(records, first * RECORD, RECORD, rows)


@inlined
def _store2(array, first, x, y):
    """Write 16 rows of an (n, 2) array."""
    store_rows(array, 2 * first, LANES, interleave((x, y)))


@inlined
def _block_colours(sh, sh_width, degree, first, mean, camera, is_needed, transposed, basis, colour_slopes):
    """Return red, green and blue of the 16 Gaussians from `first` on, and write their gradients by the means to
    colour_slopes unless it is empty; zeros unless is_needed.

    mean: vectors x, y, z of the means. transposed, basis: workspaces of TRANSPOSED and SQUARE numbers. The module head
    lists the others.
    """
    red, green, blue = splat(ZERO), splat(ZERO), splat(ZERO)
    if is_needed:
        harmonics.load_transposed(sh, first, sh_width, 3 * (degree + 1) * (degree + 1), transposed)
        direction, inverse = _direction(mean, camera)
        red, green, blue = harmonics.colours(transposed, degree, direction[0], direction[1], direction[2], basis)
        if colour_slopes.size > 0:
            _colour_slopes(transposed, degree, direction, inverse, colour_slopes)
    elif colour_slopes.size > 0:
        for i in range(SLOPES):
            store(colour_slopes, i * LANES, splat(ZERO))
    return red, green, blue


@inlined
def _colour_slopes(transposed, degree, direction, inverse_distance, colour_slopes):
    """Write the gradient of each colour by the mean: the slope's component tangential to the sphere of directions, over
    the distance. transposed: coefficients from `spherical_harmonics.load_transposed`."""
    for channel in range(3):
        g = harmonics.colour_slope(transposed, degree, direction[0], direction[1], direction[2], channel)
        g = _scale(inverse_distance, _add_scaled(g, -_dot(g, direction), direction))
        store_rows(colour_slopes, 3 * channel * LANES, LANES, g)


@kernel
def project(
    counter, scratch, means, quats, scales, opacities, sh, sh_width, degree, raw, camera, width, height,
    records, centres, radii, depths, max_tiles, small_tiles, small_rows, first_slots, chunk_max_tiles, d_centres,
    colour_slopes,
):  # fmt: skip
    """Project n >= 16 Gaussians, on all threads; sets d_centres to zero.

    counter: index of the next chunk; scratch: workspace of SCRATCH numbers. The module head lists the others."""
    n = opacities.size
    transposed, basis = scratch[:TRANSPOSED], scratch[TRANSPOSED : TRANSPOSED + SQUARE]
    while True:
        chunk = atomic_increment(counter)
        start, end = chunk * CHUNK, min(chunk * CHUNK + CHUNK, n)
        if start >= n:
            break
        for block in range(start, end, LANES):
            first = min(block, n - LANES)  # the last block overlaps the one before and writes the same again
            _project_block(
                means, quats, scales, opacities, sh, sh_width, degree, raw, camera, width, height, first, transposed,
                basis, records, centres, radii, depths, max_tiles, small_tiles, small_rows,
                colour_slopes[block * SLOPES :],
            )  # fmt: skip
        chunk_max_tiles[chunk] = exclusive_sum(max_tiles, start, end, first_slots)
        d_centres[2 * start : 2 * end] = ZERO


@inlined
def _gradients_from_moments(fields, xy, yy, determinant):
    """Return the gradients of the centre and of the covariance xx, xy (which stands for both places), yy.

    fields: the summed gradient rows, one vector per field. With e = covariance^-1 d: dL/dcentre = sum g e,
    dL/dcovariance = sum g e e^T / 2. In terms of u and d_y, e = (alpha u, alpha k u + d_y / yy) where alpha = yy /
    det."""
    inverse_y = ONE / yy
    k = -xy * inverse_y
    alpha = yy / determinant
    alpha_k = alpha * k
    d_x = alpha * fields[G_U]
    d_y = fma(alpha_k, fields[G_U], inverse_y * fields[G_Y])
    uu, uy, dd = alpha * fields[G_UU], inverse_y * fields[G_UY], inverse_y * inverse_y * fields[G_YY]
    d_xx = alpha * uu * HALF
    d_xy = fma(alpha_k, uu, alpha * uy)
    d_yy = fma(alpha_k * k, uu, fma(alpha_k * TWO, uy, dd)) * HALF
    return d_x, d_y, d_xx, d_xy, d_yy


@inlined
def _sum_rows(gradients, first_slot, count):
    """Return the sum of the gradient rows of one Gaussian."""
    row, index, end, opaque_record = splat(ZERO), first_slot * RECORD, (first_slot + count) * RECORD, opaque(RECORD)
    while index < end:
        row = row + load(gradients, index)
        index += opaque_record
    return row


@inlined
def _gather_gradients(gradients, first_slots, counts, first, rows):
    """Return the summed gradient rows of the 16 Gaussians from `first` on, one vector per field; first_slots, counts:
    slots of each Gaussian; rows: workspace."""
    for i in range(LANES):
        first_slot, count = load_scalar(first_slots, first + i), load_scalar(counts, first + i)
        store(rows, i * LANES, _sum_rows(gradients, first_slot, count))
    return transpose(load_rows(rows, 0, LANES))


@inlined
def _add_to(sums, sum_index, value, is_new):
    store(sums, sum_index * LANES, load(sums, sum_index * LANES) + where(is_new, value, ZERO))


@inlined
def _add_camera_gradients(sums, is_new, mean, q, dv, dp, offset, intrinsics):
    """Add the camera gradients of 16 Gaussians; is_new: lanes that are not counted yet.

    mean, q: m and the rows of Q. dv, dp, offset: gradients of V, of p, and of the offset from the camera to the mean.
    intrinsics: gradients of fx, fy, cx, cy.
    The gradient of R is dV Q^T, from V = R Q, plus dp m^T, from p = R m + t; that of the camera's position is the
    opposite of `offset`.
    """
    for i in range(3):
        _add_to(sums, 3 * i, _dot(dv[i], q[0]) + dp[i] * mean[0], is_new)
        _add_to(sums, 3 * i + 1, _dot(dv[i], q[1]) + dp[i] * mean[1], is_new)
        _add_to(sums, 3 * i + 2, _dot(dv[i], q[2]) + dp[i] * mean[2], is_new)
        _add_to(sums, 9 + i, dp[i], is_new)
        _add_to(sums, POSITION_SUM + i, -offset[i], is_new)
    for i in range(4):
        _add_to(sums, 12 + i, intrinsics[i], is_new)


@inlined
def _offset_gradient(d_colour, colour_slopes):
    """Return the gradient of the offset from the camera to the means through the colours; colour_slopes: the
    gradients of the colours by the means, 9 vectors."""
    slopes = colour_slopes
    result = _scale(d_colour[0], (load(slopes, 0), load(slopes, 16), load(slopes, 32)))
    result = _add_scaled(result, d_colour[1], (load(slopes, 48), load(slopes, 64), load(slopes, 80)))
    return _add_scaled(result, d_colour[2], (load(slopes, 96), load(slopes, 112), load(slopes, 128)))


@inlined
def _project_block_backward(
    means, quats, scales, opacities, sh_width, degree, raw, camera, records, colour_slopes, first, is_new, fields,
    transposed, rows, d_means, d_quats, d_scales, d_opacities, d_sh, target_row, keep_cached, d_centres, sums,
    with_camera,
):  # fmt: skip
    """Write the gradients (d_...) of the 16 Gaussians from `first` on: d_centres to rows from `first` on, the others to
    rows from target_row on.

    fields: the summed gradient rows, one vector per field; colour_slopes: of this block; keep_cached: keep the
    gradients of sh in the cache, since they are read soon; with_camera, is_new, sums: for the camera, see
    `_add_camera_gradients`; transposed, rows: workspaces. The module head lists the others."""
    mean, scale = _load3(means, first), _load_scales(scales, first, raw)
    px, py, pz = _to_camera(camera, mean)
    is_in_front = pz > camera[NEAR]
    inverse_z = ONE / where(is_in_front, pz, ONE)
    slopes = (px * inverse_z, py * inverse_z)
    (qw, qx, qy, qz), inverse_norm = _normalise(_load4(quats, first))
    q = _rotation(qw, qx, qy, qz)
    v = _rotate_to_camera(camera, q)
    a, b, ux, uy = _image_axes(camera, v, scale, slopes, inverse_z)
    _, xy, yy, determinant = _covariance(a, b, camera[DILATION])
    is_drawable = is_in_front & (determinant > ZERO) & (determinant < MAX_DETERMINANT) & (yy > ZERO)
    yy, determinant = where(is_drawable, yy, ONE), where(is_drawable, determinant, ONE)
    dx, dy, d_xx, d_xy, d_yy = _gradients_from_moments(fields, xy, yy, determinant)
    _store2(d_centres, first, dx, dy)

    opacity = _load_opacities(opacities, first, raw)
    is_unclamped = (opacity <= OPACITY_MAX) & (opacity >= ALPHA_MIN)
    # G is the gradient by ln opacity; by the logit it is 1 - opacity times as large
    d_opacity = fields[G] * (ONE - opacity) if raw else fields[G] / where(is_unclamped, opacity, ONE)
    store(d_opacities, target_row, where(is_unclamped, d_opacity, ZERO))

    # covariance -> a, b -> V, scales, slopes, depth; na, nb, n2: gradients of V_0 S, V_1 S, V_2 S
    da = _add_scaled(_scale(d_xx * TWO, a), d_xy, b)
    db = _add_scaled(_scale(d_yy * TWO, b), d_xy, a)
    a_da, b_db = _dot(a, da), _dot(b, db)
    na, nb = _scale(inverse_z * camera[FX], da), _scale(inverse_z * camera[FY], db)
    n2 = _add_scaled(_scale(-ux, na), -uy, nb)
    v2s = _multiply_elements(v[2], scale)
    d_ux, d_uy = -_dot(na, v2s), -_dot(nb, v2s)
    d_scale = (
        fma(na[0], v[0][0], fma(nb[0], v[1][0], n2[0] * v[2][0])),
        fma(na[1], v[0][1], fma(nb[1], v[1][1], n2[1] * v[2][1])),
        fma(na[2], v[0][2], fma(nb[2], v[1][2], n2[2] * v[2][2])),
    )
    _store3(d_scales, target_row, _multiply_elements(d_scale, scale) if raw else d_scale)
    dv = (_multiply_elements(na, scale), _multiply_elements(nb, scale), _multiply_elements(n2, scale))
    gw, gx, gy, gz = _rotation_backward(qw, qx, qy, qz, _rotate_to_world(camera, dv))
    radial = fma(gw, qw, _dot((gx, gy, gz), (qx, qy, qz)))
    radial = where(inverse_norm < MAX_INVERSE_NORM, radial, ZERO)  # shorter quaternions were scaled by a constant
    _store4(d_quats, target_row, (
        (gw - qw * radial) * inverse_norm, (gx - qx * radial) * inverse_norm,
        (gy - qy * radial) * inverse_norm, (gz - qz * radial) * inverse_norm,
    ))  # fmt: skip

    inside_x = (slopes[0] >= camera[LOW_X]) & (slopes[0] <= camera[HIGH_X])
    inside_y = (slopes[1] >= camera[LOW_Y]) & (slopes[1] <= camera[HIGH_Y])
    d_sx = fma(dx, camera[FX], where(inside_x, d_ux, ZERO))
    d_sy = fma(dy, camera[FY], where(inside_y, d_uy, ZERO))
    d_pz = fields[G_DEPTH] - inverse_z * (fma(d_sx, slopes[0], d_sy * slopes[1]) + a_da + b_db)
    dp = (d_sx * inverse_z, d_sy * inverse_z, d_pz)

    # colour -> coefficients, direction; colours that are 0 in the record were clamped
    record_fields = transpose(load_rows(records, first * RECORD, RECORD))
    d_colour = (
        where(record_fields[RED] > ZERO, fields[G_RED], ZERO),
        where(record_fields[GREEN] > ZERO, fields[G_GREEN], ZERO),
        where(record_fields[BLUE] > ZERO, fields[G_BLUE], ZERO),
    )
    direction, _ = _direction(mean, camera)
    harmonics.coefficients_backward(degree, direction[0], direction[1], direction[2], d_colour, rows, transposed)
    harmonics.store_transposed(transposed, target_row, sh_width, d_sh, keep_cached)
    offset = _offset_gradient(d_colour, colour_slopes)
    d_mean = (
        fma(dp[0], camera[0], fma(dp[1], camera[3], fma(dp[2], camera[6], offset[0]))),
        fma(dp[0], camera[1], fma(dp[1], camera[4], fma(dp[2], camera[7], offset[1]))),
        fma(dp[0], camera[2], fma(dp[1], camera[5], fma(dp[2], camera[8], offset[2]))),
    )
    _store3(d_means, target_row, d_mean)
    if with_camera:
        intrinsics = (fma(dx, slopes[0], a_da / camera[FX]), fma(dy, slopes[1], b_db / camera[FY]), dx, dy)
        _add_camera_gradients(sums, is_new, mean, q, dv, dp, offset, intrinsics)


@kernel
def project_backward(
    counter, scratch, parameters, sh_width, degree, raw, camera, records, colour_slopes, gradients, first_slots,
    counts, d_parameters, d_centres, d_camera, with_camera, first_moments, second_moments, rates, constants,
):  # fmt: skip
    """Write the gradients of all inputs from the rasterizer's gradient rows.

    parameters: means, quats, scales, opacities, and sh if they are stepped; d_parameters: the gradients of all five. If
    these are empty, the parameters are stepped by their gradients instead, chunk by chunk; first_moments,
    second_moments, rates, constants: of Adam, an array for each parameter. gradients: one row for each pair of
    Gaussian and tile; Gaussian i has counts[i] rows from first_slots[i] on. d_camera (chunks, CAMERA_SUMS): sums of
    each chunk, if with_camera. counter: index of the next chunk, from the end; scratch: workspace of SCRATCH numbers,
    or of STEP_SCRATCH if parameters are stepped. The module head lists the others."""
    means, quats, scales, opacities, _ = parameters
    n = opacities.size
    transposed, rows = scratch[:TRANSPOSED], scratch[TRANSPOSED : TRANSPOSED + SQUARE]
    sums = scratch[TRANSPOSED + SQUARE : SCRATCH]
    steps_parameters = d_parameters[0].size == 0
    targets = d_parameters
    if steps_parameters:
        chunk_scratch, capacity = scratch[SCRATCH:], CHUNK_CAPACITY
        targets = (
            chunk_scratch[: 3 * capacity], chunk_scratch[3 * capacity : 7 * capacity],
            chunk_scratch[7 * capacity : 10 * capacity], chunk_scratch[10 * capacity : 11 * capacity],
            chunk_scratch[11 * capacity :],
        )  # fmt: skip
    d_means, d_quats, d_scales, d_opacities, d_sh = targets
    chunks = max(1, n // CHUNK + np.int64(n % CHUNK >= LANES))  # a remainder below 16 joins the last chunk
    while True:  # last to first: the next iteration begins with the chunks that are still in the cache
        chunk = chunks - 1 - atomic_increment(counter)
        if chunk < 0:
            break
        start, end = chunk * CHUNK, (chunk + 1) * CHUNK if chunk < chunks - 1 else n
        if with_camera:
            for i in range(0, CAMERA_SUMS * LANES, LANES):
                store(sums, i, splat(ZERO))
        for block in range(start, end, LANES):
            first = min(block, end - LANES)  # the last block overlaps the one before
            fields = _gather_gradients(gradients, first_slots, counts, first, rows)
            is_new = lane_index() >= np.float32(block - first)
            _project_block_backward(
                means, quats, scales, opacities, sh_width, degree, raw, camera, records,
                colour_slopes[block * SLOPES :], first, is_new, fields, transposed, rows, d_means, d_quats, d_scales,
                d_opacities, d_sh,
                first - start if steps_parameters else first, steps_parameters, d_centres, sums, with_camera,
            )  # fmt: skip
        if steps_parameters:
            for i in range(len(parameters)):
                width = parameters[i].size // n
                start_number, end_number = start * width, end * width
                step_array(
                    parameters[i][start_number:end_number], targets[i], first_moments[i][start_number:end_number],
                    second_moments[i][start_number:end_number], rates[i], unpack_constants(constants[i]),
                )  # fmt: skip
        if with_camera:
            for i in range(CAMERA_SUMS):
                total = ZERO
                for lane in range(LANES):
                    total += sums[i * LANES + lane]
                d_camera[chunk, i] = total
