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
on the number of threads.
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
    is_needle,
    needle_offsets,
    next_entry,
    run_length,
    start_run,
    start_tile,
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
EDGE = 3 * TILE_WIDTH
SCRATCH = STATE + 6 * EDGE


@inlined
def _load_gradients(
    state, row, pixel, background, image, alphas, depths, d_image, d_alphas, d_depths, with_depth
):  # fmt: skip
    """Write one row of pixel gradients, and S before the first Gaussian, for 16 pixels from the flat index `pixel` on.

    The background counts as an opposite gradient of alpha. Depth adds nothing to S, since the sum of
    w (depth - mean depth) is 0."""
    at = row * ROW
    at_colour = 3 * pixel
    colour = deinterleave((load(image, at_colour), load(image, at_colour + 16), load(image, at_colour + 32)))
    v = deinterleave((load(d_image, at_colour), load(d_image, at_colour + 16), load(d_image, at_colour + 32)))
    alpha = load(alphas, pixel)
    t = ONE - alpha
    behind = fma(v[0], background[0], fma(v[1], background[1], v[2] * background[2]))
    v_alpha = (load(d_alphas, pixel) if d_alphas.size > 0 else splat(ZERO)) - behind
    s = fma(v[0], colour[0], fma(v[1], colour[1], v[2] * colour[2])) - t * behind
    if with_depth:
        store(state, at + V_DEPTH, load(d_depths, pixel) / where(alpha > DEPTH_ALPHA_MIN, alpha, DEPTH_ALPHA_MIN))
        store(state, at + MEAN_DEPTH, load(depths, pixel))
    store(state, at + S_PLANE, fma(v_alpha, alpha, s))
    store(state, at + V_RED, v[0])
    store(state, at + V_GREEN, v[1])
    store(state, at + V_BLUE, v[2])
    store(state, at + V_ALPHA, v_alpha)


@inlined
def row_gradient(state, at, e, records, record, with_depth):
    """Return g and w (see the module head) of one row of a Gaussian, and update T and S.

    at: offset of the row in the state; e: opacity times profile."""
    t, s = load(state, at + T_PLANE), load(state, at + S_PLANE)
    counts = (e >= ALPHA_MIN) & (t >= T_MIN)
    w = where(counts, t * e, ZERO)
    vc = fma(load(state, at + V_RED), load_scalar(records, record + RED), load(state, at + V_ALPHA))
    vc = fma(load(state, at + V_GREEN), load_scalar(records, record + GREEN), vc)
    vc = fma(load(state, at + V_BLUE), load_scalar(records, record + BLUE), vc)
    if with_depth:
        vc = fma(load(state, at + V_DEPTH), load_scalar(records, record + DEPTH) - load(state, at + MEAN_DEPTH), vc)
    wvc = w * vc
    s = s - wvc
    store(state, at + S_PLANE, s)
    store(state, at + T_PLANE, t - w)
    return wvc - s * where(counts, e / (ONE - e), ZERO), w


@inlined
def _add_colours(state, at, w, sums, with_depth):
    """Add w v to the sums for red, green, blue and depth."""
    d_red = fma(w, load(state, at + V_RED), sums[0])
    d_green = fma(w, load(state, at + V_GREEN), sums[1])
    d_blue = fma(w, load(state, at + V_BLUE), sums[2])
    d_depth = fma(w, load(state, at + V_DEPTH), sums[3]) if with_depth else sums[3]
    return d_red, d_green, d_blue, d_depth


@inlined
def _needle_sums(state, records, at, left, top, first, end, with_depth):
    """Return sums of g u, g d_y, g u², g u d_y, g d_y², g and colours, with an exponential for each row."""
    zero = splat(ZERO)
    m, mu, my, muu, muy, myy = zero, zero, zero, zero, zero, zero
    colours = (zero, zero, zero, zero)
    row, one = first, opaque(1)
    while row < end:
        u, dy = needle_offsets(records, at, left, top + row)
        e = falloff(records, at, u, dy) * load_scalar(records, at + OPACITY)
        g, w = row_gradient(state, row * ROW, e, records, at, with_depth)
        colours = _add_colours(state, row * ROW, w, colours, with_depth)
        gu, gy = g * u, g * dy
        m, mu, my = m + g, mu + gu, my + gy
        muu, muy, myy = fma(gu, u, muu), fma(gu, dy, muy), fma(gy, dy, myy)
        row += one
    return mu, my, muu, muy, myy, m, colours


@inlined
def moments(records, at, left, m0, m1, m2):
    """Return sums of g times u, d_y, u², u d_y, d_y² in each lane, from m_i = sum g d_y^i. With u = d_x + k d_y,

    sum g u = d_x m0 + k m1,   sum g u d_y = d_x m1 + k m2,   sum g u² = d_x (d_x m0 + 2 k m1) + k² m2
    """
    k = load_scalar(records, at + K)
    dx = lane_index() + (np.float32(left) + HALF - load_scalar(records, at + X))
    mu = fma(dx, m0, m1 * k)
    return mu, m1, fma(dx, fma(m1, k, mu), m2 * (k * k)), fma(dx, m1, m2 * k), m2


@inlined
def _recurrence_sums(state, records, at, left, top, first, end, start, with_depth):
    """Return the sums of `_needle_sums` by the recurrence and three running sums per lane: of g over the rows, of the
    values of the first sum, and of those of the second. A row j rows above the end counts 1, j and j (j + 1) / 2 times
    in them."""
    step, one, run = load_scalar(records, at + STEP), opaque(1), run_length(records, at)
    zero = splat(ZERO)
    m0, m1, m2 = zero, zero, zero
    colours = (zero, zero, zero, zero)
    e, r, top_dy = start
    row, stop = first, min(first + run, end)
    while True:
        while row < stop:
            g, w = row_gradient(state, row * ROW, e, records, at, with_depth)
            colours = _add_colours(state, row * ROW, w, colours, with_depth)
            m0 = m0 + g
            m1 = m1 + m0
            m2 = m2 + m1
            e = e * r
            r = fma(r, step, r)
            row += one
        if row >= end:
            break
        e, r, _ = start_run(records, at, left, top + row)
        stop = min(row + run, end)
    # below: d_y of the row below the last; j rows above it d_y = below - j, and j² = 2 (j (j + 1) / 2) - j
    below = top_dy + np.float32(end - first)
    m2 = m0 * (below * below) - m1 * (below * TWO + ONE) + m2 * TWO
    m1 = m0 * below - m1
    mu, my, muu, muy, myy = moments(records, at, left, m0, m1, m2)
    return mu, my, muu, muy, myy, m0, colours


@inlined
def _gradient_row(state, records, at, left, top, first, end, start, with_depth):
    """Return the gradient row (see `layout`) of one Gaussian in one tile."""
    if is_needle(records, at, end - first):
        mu, my, muu, muy, myy, m, colours = _needle_sums(state, records, at, left, top, first, end, with_depth)
    else:
        mu, my, muu, muy, myy, m, colours = _recurrence_sums(
            state, records, at, left, top, first, end, start, with_depth
        )
    return reduce_add_each((mu, my, muu, muy, myy, m, colours[0], colours[1], colours[2], colours[3]))


@inlined
def _edge_row(edge, pixel, count, image, alphas, depths, d_image, d_alphas, d_depths, with_depth):
    """Copy the `count` pixels of a tile row that lie inside the picture to `edge` (6, EDGE), zeros beyond.

    pixel: flat index of the first. Rows of edge: image, its gradient, then alpha and depth, each with its gradient."""
    edge[:, :] = ZERO
    lane, one = 0, opaque(1)
    while lane < 3 * count:
        edge[0, lane], edge[1, lane] = image[3 * pixel + lane], d_image[3 * pixel + lane]
        lane += one
    lane = 0
    while lane < count:
        edge[2, lane] = alphas[pixel + lane]
        if d_alphas.size > 0:
            edge[3, lane] = d_alphas[pixel + lane]
        if with_depth:
            edge[4, lane], edge[5, lane] = depths[pixel + lane], d_depths[pixel + lane]
        lane += one


@inlined
def load_tile(
    state, left, top, width, height, background, image, alphas, depths, d_image, d_alphas, d_depths, with_depth, edge
):  # fmt: skip
    """Write the state of a tile before its first Gaussian; edge: workspace for tiles that the picture's edge cuts."""
    start_tile(state, ROW, left, top, width, height)
    row, one = 0, opaque(1)
    while row < min(TILE_HEIGHT, height - top):
        pixel = (top + row) * width + left
        if left + TILE_WIDTH <= width:
            _load_gradients(
                state, row, pixel, background, image, alphas, depths, d_image, d_alphas, d_depths, with_depth
            )
        else:
            _edge_row(
                edge, pixel, width - left, image, alphas, depths, d_image, d_alphas, d_depths, with_depth
            )
            _load_gradients(  # pixel * 0: `edge` begins at index 0; a constant would be compiled as another version
                state, row, pixel * 0, background, edge[0], edge[2], edge[4], edge[1], edge[3], edge[5], with_depth
            )
        row += one


@inlined
def _tile_backward(entries, begin, used, end, records, left, top, state, gradients, with_depth):
    """Write the gradient rows of a tile's entries begin .. end; zeros from `used` on, which were not drawn."""
    if begin < used:
        upcoming = next_entry(entries, begin, end, records, left, top)
        for e in range(begin, used):
            at, first, last, start = upcoming
            upcoming = next_entry(entries, e + 1, end, records, left, top)
            far = min(e + PREFETCH_DISTANCE, end - 1)
            prefetch_to_write(gradients, load_scalar(entries, far * ENTRY + SLOT) * RECORD)
            row = _gradient_row(state, records, at, left, top, first, last, start, with_depth)
            store(gradients, load_scalar(entries, e * ENTRY + SLOT) * RECORD, row)
    for e in range(used, end):
        store(gradients, load_scalar(entries, e * ENTRY + SLOT) * RECORD, splat(ZERO))


@kernel
def raster_backward(
    counter, scratch, entries, starts, ends, records, background, width, height, tiles_x, image, alphas, depths,
    d_image, d_alphas, d_depths, gradients,
):  # fmt: skip
    """Write the gradient row of each slot, RECORD numbers, to `gradients`. d_alphas and d_depths may be empty.

    starts, ends: see `raster`; scratch: workspace of SCRATCH numbers."""
    state, edge = scratch[:STATE], scratch[STATE:SCRATCH].reshape(6, EDGE)
    with_depth = d_depths.size > 0
    while True:
        tile = atomic_increment(counter)
        if tile >= ends.size:
            break
        left, top = (tile % tiles_x) * TILE_WIDTH, (tile // tiles_x) * TILE_HEIGHT
        begin, used, end = starts[tile], ends[tile], starts[tile + 1]
        load_tile(
            state, left, top, width, height, background, image, alphas, depths, d_image, d_alphas, d_depths,
            with_depth, edge,
        )  # fmt: skip
        if with_depth:  # two loops for LLVM to specialise
            _tile_backward(entries, begin, used, end, records, left, top, state, gradients, with_depth)
        else:
            _tile_backward(entries, begin, used, end, records, left, top, state, gradients, with_depth)
