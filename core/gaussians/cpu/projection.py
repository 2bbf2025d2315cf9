# SPDX-License-Identifier: GPL-3.0-or-later
"""Projects 3D Gaussians to records of 64 bytes, and their gradients back; 16 Gaussians at a time. Called by `scene`.

`ellipse` has the geometry. A record holds a Gaussian's centre, its square completed (A, k, D), and what the rasterizer
needs beside it: from one pixel row to the next the exponent's second difference is 2 C with C = A k² + D, and the
rasterizer's recurrence uses `step` = 2^(2 C) - 1 and `run` = sqrt(-40 / C), the number of rows over which e falls from
its peak to 2^-40.

With `raw`, scales are logarithms and opacities logits, the form in which they are optimised.

In the backward pass the rasterizer provides the moments of `ellipse`. The gradients of colour and depth are sums
themselves.

Arguments, all flat:

    means, quats, scales, opacities   see `rasterization`; with `raw`, logarithms and logits
    sh, sh_width     coefficients, and how many numbers of them a Gaussian has
    degree           of the harmonics that are used
    camera           from `ellipse.pack_camera`
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

import numpy as np

from . import spherical_harmonics as harmonics
from .binning import exclusive_sum, small_footprints
from .compilation import inlined, kernel
from .ellipse import (
    FX,
    FY,
    MARGIN,
    POSITION,
    add_scaled,
    axes_backward,
    dot,
    ellipses,
    load_opacities,
    mean_gradient,
    opacity_gradient,
    project_axes,
    scaled,
)
from .layout import (
    BLUE,
    CHUNK,
    G_BLUE,
    G_DEPTH,
    G_GREEN,
    G_RED,
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
    exp2m1,
    fma,
    lane_index,
    load,
    load_rows,
    load_scalar,
    maximum,
    minimum,
    opaque,
    splat,
    sqrt,
    store,
    store2,
    store3,
    store4,
    store_rows,
    to_ints,
    transpose,
    where,
)

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

TINY = np.float32(1e-24)
"""Smallest squared distance from the camera; its inverse root is finite."""
INFINITY = np.float32(np.inf)
RUN_LOG2_RANGE, RUN_MAX = np.float32(40), np.float32(32)
"""Bounds of a run of the recurrence in powers of two and in rows (see `raster_forward`), since rounding accumulates."""


@inlined
def _direction(mean, camera):
    """Return unit vectors from the camera to the means, and the inverse distances."""
    x, y, z = mean[0] - camera[POSITION], mean[1] - camera[POSITION + 1], mean[2] - camera[POSITION + 2]
    inverse = ONE / sqrt(maximum(dot((x, y, z), (x, y, z)), TINY))
    return scaled(inverse, (x, y, z)), inverse


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
    axes = project_axes(means, quats, scales, raw, camera, first)
    opacity = minimum(splat(OPACITY_MAX), load_opacities(opacities, first, raw))  # NaN, as second, stays NaN
    e = ellipses(axes, opacity, camera, width, height)
    store2(centres, first, (e.x, e.y))
    half_difference = (e.xx - e.yy) * HALF
    largest_variance = (e.xx + e.yy) * HALF + sqrt(fma(half_difference, half_difference, e.xy * e.xy))
    store(radii, first, where(e.is_visible & (e.reach > ZERO), sqrt(largest_variance) * np.float32(3), ZERO))

    store(depths, first, where(e.is_visible, axes.point[2], INFINITY))
    curvature = fma(e.major * e.k, e.k, e.minor)
    # Half a pixel wider than `binning` lists, so that rounding cannot make the bound too low.
    bound = _tiles_bound(e.x, e.y, e.half_x + HALF, e.half_y + HALF, e.is_visible, width, height)
    store(max_tiles, first, bound)
    first_tile, packed_rows = small_footprints(
        e.x, e.y, e.half_x, e.half_y, e.major, e.k, e.minor, -(e.reach + MARGIN), e.is_visible, width, height
    )
    store(small_tiles, first, first_tile)
    store(small_rows, first, packed_rows)

    red, green, blue = _block_colours(
        sh, sh_width, degree, first, axes.mean, camera, any_of(e.is_visible), transposed, basis, colour_slopes
    )
    rows = transpose((
        e.x, e.y, e.major, e.k, e.minor, opacity, exp2m1(curvature * TWO),
        minimum(sqrt(RUN_LOG2_RANGE / -curvature), RUN_MAX),
        maximum(red, ZERO), maximum(green, ZERO), maximum(blue, ZERO), axes.point[2],
        -(e.reach + MARGIN), e.half_x, e.half_y, splat(ZERO),
    ))  # fmt: skip
    store_rows(records, first * RECORD, RECORD, rows)


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
        g = scaled(inverse_distance, add_scaled(g, -dot(g, direction), direction))
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
        _add_to(sums, 3 * i, dot(dv[i], q[0]) + dp[i] * mean[0], is_new)
        _add_to(sums, 3 * i + 1, dot(dv[i], q[1]) + dp[i] * mean[1], is_new)
        _add_to(sums, 3 * i + 2, dot(dv[i], q[2]) + dp[i] * mean[2], is_new)
        _add_to(sums, 9 + i, dp[i], is_new)
        _add_to(sums, POSITION_SUM + i, -offset[i], is_new)
    for i in range(4):
        _add_to(sums, 12 + i, intrinsics[i], is_new)


@inlined
def _offset_gradient(d_colour, colour_slopes):
    """Return the gradient of the offset from the camera to the means through the colours; colour_slopes: the
    gradients of the colours by the means, 9 vectors."""
    slopes = colour_slopes
    result = scaled(d_colour[0], (load(slopes, 0), load(slopes, 16), load(slopes, 32)))
    result = add_scaled(result, d_colour[1], (load(slopes, 48), load(slopes, 64), load(slopes, 80)))
    return add_scaled(result, d_colour[2], (load(slopes, 96), load(slopes, 112), load(slopes, 128)))


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
    axes = project_axes(means, quats, scales, raw, camera, first)
    gradients = axes_backward(axes, fields, camera, raw, fields[G_DEPTH])
    store2(d_centres, first, gradients.centre)
    opacity = load_opacities(opacities, first, raw)
    store(d_opacities, target_row, opacity_gradient(opacity, fields[G], raw))
    store3(d_scales, target_row, gradients.scale)
    store4(d_quats, target_row, gradients.quaternion)

    # colour -> coefficients, direction; colours that are 0 in the record were clamped
    record_fields = transpose(load_rows(records, first * RECORD, RECORD))
    d_colour = (
        where(record_fields[RED] > ZERO, fields[G_RED], ZERO),
        where(record_fields[GREEN] > ZERO, fields[G_GREEN], ZERO),
        where(record_fields[BLUE] > ZERO, fields[G_BLUE], ZERO),
    )
    direction, _ = _direction(axes.mean, camera)
    harmonics.coefficients_backward(degree, direction[0], direction[1], direction[2], d_colour, rows, transposed)
    harmonics.store_transposed(transposed, target_row, sh_width, d_sh, keep_cached)
    offset = _offset_gradient(d_colour, colour_slopes)
    store3(d_means, target_row, mean_gradient(gradients.point, camera, offset))
    if with_camera:
        (dx, dy), (d_fx, d_fy), slopes = gradients.centre, gradients.focal, axes.slopes
        intrinsics = (fma(dx, slopes[0], d_fx / camera[FX]), fma(dy, slopes[1], d_fy / camera[FY]), dx, dy)
        _add_camera_gradients(
            sums, is_new, axes.mean, axes.rotation, gradients.seen, gradients.point, offset, intrinsics
        )


@inlined
def _add_array(sums, values):
    """Add values to the first numbers of an array."""
    vector_end = values.size - values.size % LANES
    for i in range(0, vector_end, LANES):
        store(sums, i, load(sums, i) + load(values, i))
    for i in range(vector_end, values.size):
        sums[i] += values[i]


@kernel
def project_backward(
    counter, scratch, parameters, sh_width, degree, raw, camera, records, colour_slopes, gradients, first_slots,
    counts, d_parameters, d_centres, d_camera, with_camera, first_moments, second_moments, rates, constants, added,
):  # fmt: skip
    """Write the gradients of all inputs from the rasterizer's gradient rows.

    parameters: means, quats, scales, opacities, and sh if they are stepped; d_parameters: the gradients of all five. If
    these are empty, the parameters are stepped by their gradients instead, chunk by chunk; first_moments,
    second_moments, rates, constants: of Adam, an array for each parameter; added: gradients that are added to these,
    empty for none. gradients: one row for each pair of
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
                if added[i].size > 0:
                    _add_array(targets[i], added[i][start_number:end_number])
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
