# SPDX-License-Identifier: GPL-3.0-or-later
"""The gradients of `raster_forward`, in the same order, front to back.

With v the gradient of a pixel's colour, one number per pixel and Gaussian matters: vc = v . colour, plus the
gradient of alpha, plus that of depth times (its depth - the pixel's) / alpha. What lies behind a Gaussian
contributes S' = sum of w vc over all later ones: the sum over all, known from the final picture, minus that over the
Gaussians up to this one:

    w = T alpha,   S' = S - w vc,   T' = T - w,   dL/dalpha = T vc - S' / (1 - alpha)
    g = dL / d ln alpha = w vc - S' alpha / (1 - alpha)

The projection needs only sums of g times 1, u, d_y and their products over the pixels. In each lane u depends on the
row through k d_y alone, so three sums per lane suffice, combined after the last row (`moments`). Needles (see
`raster_forward`) sum the products themselves, which would cancel otherwise.

Every pair of Gaussian and tile writes its own row: no two threads write to the same memory, and the sums do not depend
on the number of threads. The head of `raster_forward` lists the arguments.
"""
from __future__ import annotations

import numpy as np

from .compilation import inlined, kernel
from .layout import (
    ALPHA_MIN,
    BLUE,
    DEPTH,
    ENTRY,
    GREEN,
    HALF,
    ONE,
    OPACITY,
    RECORD,
    RED,
    SLOT,
    STEP,
    T_MIN,
    TILE_HEIGHT,
    TILE_WIDTH,
    TWO,
    ZERO,
    K,
    X,
)
from .raster_forward import (
    DEPTH_ALPHA_MIN,
    PREFETCH_DISTANCE,
    T_PLANE,
    falloff,
    init_tile,
    is_needle,
    needle_offsets,
    next_entry,
    run_length,
    start_run,
)
from .vector import (
    atomic_increment,
    deinterleave,
    fma,
    lane_index,
    load,
    load_scalar,
    opaque,
    prefetch_to_write,
    reduce_add_each,
    splat,
    store,
    where,
)

# The state of a tile after T: S, and the gradients of the pixels.
S_PLANE, V_RED, V_GREEN, V_BLUE, V_ALPHA, V_DEPTH, MEAN_DEPTH = (i * TILE_WIDTH for i in range(1, 8))
ROW = 9 * TILE_WIDTH  # an odd number of cache lines, so that rows fall into all sets of the cache
STATE = ROW * TILE_HEIGHT
PADDED_ROW = 3 * TILE_WIDTH
SCRATCH = STATE + 6 * PADDED_ROW


@inlined
def _init_row(
    state, row, pixel, background, image, alphas, depths, d_image, d_alphas, d_depths, with_depth
):  # fmt: skip
    """Write one row of a tile's state before its first Gaussian: S and the gradients of the pixels.

    row: number of the row in the tile; pixel: flat index of its first pixel. Alpha hides the background, so v .
    background is subtracted from the gradient of alpha. Depth adds nothing to S, since the sum of w (depth - mean
    depth) is 0."""
    state_row = row * ROW
    colour_index = 3 * pixel
    colour = deinterleave((load(image, colour_index), load(image, colour_index + 16), load(image, colour_index + 32)))
    v = deinterleave((load(d_image, colour_index), load(d_image, colour_index + 16), load(d_image, colour_index + 32)))
    alpha = load(alphas, pixel)
    transmittance = ONE - alpha
    v_background = fma(v[0], background[0], fma(v[1], background[1], v[2] * background[2]))
    v_alpha = (load(d_alphas, pixel) if d_alphas.size > 0 else splat(ZERO)) - v_background
    # The colours' part of S: v . (picture - T background).
    s_colour = fma(v[0], colour[0], fma(v[1], colour[1], v[2] * colour[2])) - transmittance * v_background
    if with_depth:
        weight = where(alpha > DEPTH_ALPHA_MIN, alpha, DEPTH_ALPHA_MIN)
        store(state, state_row + V_DEPTH, load(d_depths, pixel) / weight)
        store(state, state_row + MEAN_DEPTH, load(depths, pixel))
    store(state, state_row + S_PLANE, fma(v_alpha, alpha, s_colour))
    store(state, state_row + V_RED, v[0])
    store(state, state_row + V_GREEN, v[1])
    store(state, state_row + V_BLUE, v[2])
    store(state, state_row + V_ALPHA, v_alpha)


@inlined
def row_gradient(state, state_row, e, records, record, with_depth):
    """Return g and w (see the module head) of one row of a Gaussian, and update T and S of that row in the state.

    state_row: index of the row's first number in the state; e: opacity times profile."""
    t, s = load(state, state_row + T_PLANE), load(state, state_row + S_PLANE)
    is_drawn = (e >= ALPHA_MIN) & (t >= T_MIN)
    w = where(is_drawn, t * e, ZERO)
    vc = fma(load(state, state_row + V_RED), load_scalar(records, record + RED), load(state, state_row + V_ALPHA))
    vc = fma(load(state, state_row + V_GREEN), load_scalar(records, record + GREEN), vc)
    vc = fma(load(state, state_row + V_BLUE), load_scalar(records, record + BLUE), vc)
    if with_depth:
        depth = load_scalar(records, record + DEPTH)
        vc = fma(load(state, state_row + V_DEPTH), depth - load(state, state_row + MEAN_DEPTH), vc)
    wvc = w * vc
    s = s - wvc
    store(state, state_row + S_PLANE, s)
    store(state, state_row + T_PLANE, t - w)
    return wvc - s * where(is_drawn, e / (ONE - e), ZERO), w


@inlined
def _add_colours(state, state_row, w, sums, with_depth):
    """Return the sums for red, green, blue and depth with w v added.

    v: gradient of the pixels in this row; state_row: index of the row's first number in the state."""
    d_red = fma(w, load(state, state_row + V_RED), sums[0])
    d_green = fma(w, load(state, state_row + V_GREEN), sums[1])
    d_blue = fma(w, load(state, state_row + V_BLUE), sums[2])
    d_depth = fma(w, load(state, state_row + V_DEPTH), sums[3]) if with_depth else sums[3]
    return d_red, d_green, d_blue, d_depth


@inlined
def _needle_sums(state, records, record, left, top, first_row, end_row, with_depth):
    """Return, by lane, a needle's sums of g u, g d_y, g u², g u d_y, g d_y² and g over rows of a tile, and a tuple of
    its sums for red, green, blue and depth.

    The module head explains g, u and d_y. A needle is too narrow for the recurrence over rows, so each row has its own
    exponential. left, top: corner of the tile, px. first_row, end_row: rows of the tile, the last one excluded.
    """
    zero = splat(ZERO)
    m, mu, my, muu, muy, myy = zero, zero, zero, zero, zero, zero
    colours = (zero, zero, zero, zero)
    row, opaque_one = first_row, opaque(1)  # opaque: the loop is not unrolled
    while row < end_row:
        u, dy = needle_offsets(records, record, left, top + row)
        e = falloff(records, record, u, dy) * load_scalar(records, record + OPACITY)
        g, w = row_gradient(state, row * ROW, e, records, record, with_depth)
        colours = _add_colours(state, row * ROW, w, colours, with_depth)
        gu, gy = g * u, g * dy
        m, mu, my = m + g, mu + gu, my + gy
        muu, muy, myy = fma(gu, u, muu), fma(gu, dy, muy), fma(gy, dy, myy)
        row += opaque_one
    return mu, my, muu, muy, myy, m, colours


@inlined
def moments(records, record, left, m0, m1, m2):
    """Return sums of g times u, d_y, u², u d_y, d_y² in each lane, from m_i = sum g d_y^i. With u = d_x + k d_y,

    sum g u = d_x m0 + k m1,   sum g u d_y = d_x m1 + k m2,   sum g u² = d_x (d_x m0 + 2 k m1) + k² m2
    """
    k = load_scalar(records, record + K)
    dx = lane_index() + (np.float32(left) + HALF - load_scalar(records, record + X))
    mu = fma(dx, m0, m1 * k)
    return mu, m1, fma(dx, fma(m1, k, mu), m2 * (k * k)), fma(dx, m1, m2 * k), m2


@inlined
def _recurrence_sums(state, records, record, left, top, first_row, end_row, run_start, with_depth):
    """Return the sums of `_needle_sums` by the recurrence and three running sums per lane: after each row g is added to
    m0, then m0 to m1, then m1 to m2. In the end the row that is j rows above end_row counts 1, j and j (j + 1) / 2
    times in them, from which the moments follow."""
    step, opaque_one, run = load_scalar(records, record + STEP), opaque(1), run_length(records, record)  # not unrolled
    zero = splat(ZERO)
    m0, m1, m2 = zero, zero, zero
    colours = (zero, zero, zero, zero)
    e, r, first_dy = run_start
    row, run_end = first_row, min(first_row + run, end_row)
    while True:
        while row < run_end:
            g, w = row_gradient(state, row * ROW, e, records, record, with_depth)
            colours = _add_colours(state, row * ROW, w, colours, with_depth)
            m0 = m0 + g
            m1 = m1 + m0
            m2 = m2 + m1
            e = e * r
            r = fma(r, step, r)
            row += opaque_one
        if row >= end_row:
            break
        e, r, _ = start_run(records, record, left, top + row)
        run_end = min(row + run, end_row)
    # end_dy: d_y of end_row; j rows above it d_y = end_dy - j, and j² = 2 (j (j + 1) / 2) - j
    end_dy = first_dy + np.float32(end_row - first_row)
    m2 = m0 * (end_dy * end_dy) - m1 * (end_dy * TWO + ONE) + m2 * TWO
    m1 = m0 * end_dy - m1
    mu, my, muu, muy, myy = moments(records, record, left, m0, m1, m2)
    return mu, my, muu, muy, myy, m0, colours


@inlined
def _gradient_row(state, records, record, left, top, first_row, end_row, run_start, with_depth):
    """Return the gradient row of one Gaussian in one tile: sums of g times u, d_y, u², u d_y, d_y² and 1, then those
    for red, green, blue and depth."""
    if is_needle(records, record, end_row - first_row):
        mu, my, muu, muy, myy, m, colours = _needle_sums(
            state, records, record, left, top, first_row, end_row, with_depth
        )
    else:
        mu, my, muu, muy, myy, m, colours = _recurrence_sums(
            state, records, record, left, top, first_row, end_row, run_start, with_depth
        )
    return reduce_add_each((mu, my, muu, muy, myy, m, colours[0], colours[1], colours[2], colours[3]))


@inlined
def _pad_row(padded, pixel, count, image, alphas, depths, d_image, d_alphas, d_depths, with_depth):
    """Copy the `count` pixels of a tile row that lie inside the picture to `padded` (6, PADDED_ROW), zeros beyond.

    pixel: flat index of the first. Rows of `padded`: image, its gradient, then alpha and depth, each with its
    gradient."""
    padded[:, :] = ZERO
    i, opaque_one = 0, opaque(1)  # opaque: the loop is not unrolled
    while i < 3 * count:
        padded[0, i], padded[1, i] = image[3 * pixel + i], d_image[3 * pixel + i]
        i += opaque_one
    i = 0
    while i < count:
        padded[2, i] = alphas[pixel + i]
        if d_alphas.size > 0:
            padded[3, i] = d_alphas[pixel + i]
        if with_depth:
            padded[4, i], padded[5, i] = depths[pixel + i], d_depths[pixel + i]
        i += opaque_one


@inlined
def init_tile_backward(
    state, left, top, width, height, background, image, alphas, depths, d_image, d_alphas, d_depths, with_depth, padded
):  # fmt: skip
    """Write the state of a tile before its first Gaussian: T, S and the gradients of its pixels.

    padded: workspace (6, PADDED_ROW) for tiles that reach beyond the right edge of the picture."""
    init_tile(state, ROW, left, top, width, height)
    row, opaque_one = 0, opaque(1)  # opaque: the loop is not unrolled
    while row < min(TILE_HEIGHT, height - top):
        pixel = (top + row) * width + left
        if left + TILE_WIDTH <= width:
            _init_row(
                state, row, pixel, background, image, alphas, depths, d_image, d_alphas, d_depths, with_depth
            )
        else:
            _pad_row(
                padded, pixel, width - left, image, alphas, depths, d_image, d_alphas, d_depths, with_depth
            )
            _init_row(  # pixel * 0: `padded` begins at index 0; a constant would be compiled as another version
                state, row, pixel * 0, background, padded[0], padded[2], padded[4], padded[1], padded[3], padded[5],
                with_depth,
            )
        row += opaque_one


@inlined
def _tile_backward(entries, begin, drawn_end, end, records, left, top, state, gradients, with_depth):
    """Write the gradient rows of a tile's entries begin .. end - 1; zeros from drawn_end on, which were not drawn."""
    if begin < drawn_end:
        upcoming = next_entry(entries, begin, end, records, left, top)
        for index in range(begin, drawn_end):
            record, first_row, end_row, run_start = upcoming
            upcoming = next_entry(entries, index + 1, end, records, left, top)
            upcoming_index = min(index + PREFETCH_DISTANCE, end - 1)
            prefetch_to_write(gradients, load_scalar(entries, upcoming_index * ENTRY + SLOT) * RECORD)
            gradient_row = _gradient_row(state, records, record, left, top, first_row, end_row, run_start, with_depth)
            store(gradients, load_scalar(entries, index * ENTRY + SLOT) * RECORD, gradient_row)
    for index in range(drawn_end, end):
        store(gradients, load_scalar(entries, index * ENTRY + SLOT) * RECORD, splat(ZERO))


@kernel
def raster_backward(
    counter, scratch, entries, starts, ends, records, background, width, height, tiles_x, image, alphas, depths,
    d_image, d_alphas, d_depths, gradients,
):  # fmt: skip
    """Write the gradient row of each slot, RECORD numbers, to `gradients`; d_alphas and d_depths may be empty.

    counter: index of the next tile; scratch: workspace of SCRATCH numbers; starts (tiles + 1,): index of each tile's
    first entry; ends (tiles,): end of its drawn entries. The head of `raster_forward` lists the others."""
    state, padded = scratch[:STATE], scratch[STATE:SCRATCH].reshape(6, PADDED_ROW)
    with_depth = d_depths.size > 0
    while True:
        tile = atomic_increment(counter)
        if tile >= ends.size:
            break
        left, top = (tile % tiles_x) * TILE_WIDTH, (tile // tiles_x) * TILE_HEIGHT
        begin, drawn_end, end = starts[tile], ends[tile], starts[tile + 1]
        init_tile_backward(
            state, left, top, width, height, background, image, alphas, depths, d_image, d_alphas, d_depths,
            with_depth, padded,
        )  # fmt: skip
        if with_depth:  # the same call twice: LLVM compiles each for its with_depth
            _tile_backward(entries, begin, drawn_end, end, records, left, top, state, gradients, with_depth)
        else:
            _tile_backward(entries, begin, drawn_end, end, records, left, top, state, gradients, with_depth)
