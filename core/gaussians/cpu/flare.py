# SPDX-License-Identifier: GPL-3.0-or-later
"""Kernels that rasterize 2D Gaussians, called by `splats`.

The definition is `..reference`: plain Gaussians, rings and arcs, blended by "over" in the given order or by "add".
Records, tiles and moments are the scene's (`projection`, `binning`), so plain Gaussians blended by "over" use the
scene's kernels: they are a projected scene. The other profiles, one row at a time:

    r = sqrt(-2 ln 2 (A u² + D d_y²))      Mahalanobis distance
    ring      G = 2^-(s (r - r0)²),         s = 1 / (2 ln 2 w²)
    arc       G = G exp(b·d - m),             b·d = b_x u + b_s d_y,   b_s = b_y - k b_x
    add       picture = sum opacity colour G:   no order, no transmittance; its tiles are sums

In the backward pass g = dL / d ln alpha, as in the scene. A profile depends on centre and covariance through q alone,
so its gradients are those of the plain one with g replaced by

    h = -2 g d ln G / dq = g (r - r0) / (w² r)

and an arc depends on the centre through b·d as well: d ln G = -b. The gradients of b and m are sums of g u, g d_y and
g, since d_x is u - k d_y.

The head of `raster_forward` lists the arguments; shapes: SHAPE numbers for each Gaussian, see R0 ... ARC_NORM.
"""
from __future__ import annotations

import math

import numpy as np

from .. import rendering
from .binning import CULLED_KEY, exclusive_sum
from .compilation import inlined, kernel
from .ellipse import MARGIN
from .layout import (
    ALPHA_MIN,
    BLUE,
    CHUNK,
    DEPTH,
    END_ROW,
    ENTRY,
    FIRST_ROW,
    G_ARC_U,
    G_ARC_Y,
    G_BLUE,
    G_GREEN,
    G_R0,
    G_RED,
    G_U,
    G_UU,
    G_UY,
    G_WIDTH,
    G_Y,
    G_YY,
    GAUSSIAN,
    GREEN,
    HALF_X,
    HALF_Y,
    K_REST,
    ONE,
    OPACITY,
    OPACITY_MAX,
    REACH,
    RECORD,
    RED,
    RUN,
    SLOT,
    STEP,
    TILE_HEIGHT,
    TILE_SHIFT_X,
    TILE_SHIFT_Y,
    TILE_WIDTH,
    ZERO,
    A,
    D,
    G,
    K,
    X,
    Y,
)
from .projection import RUN_LOG2_RANGE, RUN_MAX
from .raster_backward import PADDED_ROW, SCRATCH, V_BLUE, V_GREEN, V_RED, init_tile_backward, moments, row_gradient
from .raster_backward import ROW as ROW_BACKWARD
from .raster_backward import STATE as STATE_BACKWARD
from .raster_forward import (
    BLUE_PLANE,
    CHECK_INTERVAL,
    GREEN_PLANE,
    PREFETCH_DISTANCE,
    RED_PLANE,
    ROW,
    blend_row,
    falloff,
    init_tile,
    is_finished,
    is_needle,
    needle_offsets,
    next_entry,
    row_ratio,
    run_length,
    start_run,
    write_tile,
)
from .vector import (
    any_of,
    atomic_increment,
    exp2,
    fma,
    lane_index,
    load,
    load_scalar,
    maximum,
    opaque,
    prefetch,
    reduce_add_each,
    splat,
    sqrt,
    store,
    where,
)

# Offsets in a shape: ring and arc of a Gaussian, and what is derived from them. SHARPNESS: s above; CUTOFF: the largest
# -log2 G that is drawn; ARC_U, ARC_Y, ARC_NORM: b_x, b_s and m, over ln 2.
R0, SHARPNESS, WIDTH, CUTOFF, ARC_U, ARC_Y, ARC_NORM = range(7)
SHAPE = 8

PROFILE_MIN = np.float32(rendering.PROFILE_MIN)
TWO_LN2 = np.float32(2 * math.log(2))
RADIUS_MIN = np.float32(1e-6)
RADIUS2_MIN = np.float32(1e-12)
"""Smallest Mahalanobis distance of rings, as in `..reference`, and its square."""


# --- records ---------------------------------------------------------------------------------------------


@inlined
def _cutoff_log2(opacity, add):
    """Return log2 of the peak over the smallest value that is drawn, opacity / ALPHA_MIN or 1 / PROFILE_MIN; negative
    if even the peak is below it."""
    peak_ratio = 4096.0 if add else opacity * 255.0
    return math.log(peak_ratio) / math.log(2.0) if peak_ratio >= 1.0 else -1.0


@inlined
def _arc_strength(arcs, i, xx, xy, yy):
    """Return beta = sqrt(b^T covariance b), from the arc's b and the covariance xx, xy, yy; 0 without arcs."""
    if arcs.size == 0:
        return 0.0
    b_x, b_y = np.float64(arcs[3 * i]), np.float64(arcs[3 * i + 1])
    return math.sqrt(max(xx * b_x * b_x + 2.0 * xy * b_x * b_y + yy * b_y * b_y, 0.0))


@inlined
def _tiles_along(centre, half_extent, size, tile_shift):
    """Return the number of tiles of 2^tile_shift pixels that centre - half_extent .. centre + half_extent touches along
    an axis of `size` pixels."""
    first_tile = int(max(centre - half_extent, 0.0)) >> tile_shift
    return (int(min(centre + half_extent, size - 1.0)) >> tile_shift) - first_tile + 1


@kernel
def prepare_records(
    centres, covariances, opacities, colours, rings, arcs, width, height, add,
    records, shapes, keys, max_tiles, first_slots, chunk_max_tiles,
):  # fmt: skip
    """Write record, shape, key and an upper bound on the number of tiles of each Gaussian.

    Computed in float64, because very thin Gaussians (needles) lose too much in float32: xx yy - xy² cancels. With the
    blend "add" the opacity is multiplied into the colour, and the record's is 1.

    centres, covariances, opacities, colours, rings (n 2) and arcs (n 3): the arguments of `splat`, flat; rings and arcs
    are empty if there are none. keys: the index of a Gaussian, so that the given order is kept, or CULLED_KEY.
    max_tiles (n,): upper bound on the tiles of each Gaussian; first_slots (n,): its exclusive sums within a chunk of
    CHUNK Gaussians; chunk_max_tiles (chunks,): its sum by chunk."""
    log2_scale = -0.5 / math.log(2.0)  # exponent in log2: -1/2 / ln 2, so exp(-q / 2) = 2^(log2_scale q)
    for i in range(opacities.size):
        record = i * RECORD
        xx, xy = np.float64(covariances[3 * i]), np.float64(covariances[3 * i + 1])
        yy = np.float64(covariances[3 * i + 2])
        determinant = xx * yy - xy * xy
        opacity = np.float64(opacities[i]) if add else min(np.float64(opacities[i]), rendering.OPACITY_MAX)
        r0, ring_width = (np.float64(rings[2 * i]), np.float64(rings[2 * i + 1])) if rings.size > 0 else (0.0, 1.0)
        cutoff = _cutoff_log2(opacity, add)
        # max_distance: Mahalanobis, up to which the profile is drawn; an arc moves the ring out by w² beta at most.
        plain_reach = math.sqrt(2.0 * math.log(2.0) * max(cutoff, 0.0))
        arc_offset = ring_width * ring_width * _arc_strength(arcs, i, xx, xy, yy)
        max_distance = r0 + arc_offset + abs(ring_width) * plain_reach
        keys[i], max_tiles[i] = CULLED_KEY, 0
        if not (determinant > 0 and xx > 0 and cutoff >= 0 and max_distance >= 0):
            continue
        x, y, k = np.float64(centres[2 * i]), np.float64(centres[2 * i + 1]), -xy / yy
        major, minor = log2_scale * yy / determinant, log2_scale / yy
        half_x, half_y = max_distance * math.sqrt(xx), max_distance * math.sqrt(yy)
        # Negated so that a NaN centre is culled: it would be listed in tiles that do not exist.
        if not (x + half_x > 0 and y + half_y > 0 and x - half_x < width and y - half_y < height):
            continue
        colour_gain = opacity if add else 1.0
        curvature = major * k * k + minor
        records[record + X], records[record + Y] = x, y
        records[record + A], records[record + K], records[record + D] = major, k, minor
        records[record + K_REST] = k - np.float64(records[record + K])
        records[record + OPACITY] = 1.0 if add else opacity
        records[record + STEP] = math.expm1(2.0 * curvature * math.log(2.0))
        records[record + RUN] = min(math.sqrt(RUN_LOG2_RANGE / -curvature), np.float64(RUN_MAX))
        records[record + RED], records[record + GREEN] = colour_gain * colours[3 * i], colour_gain * colours[3 * i + 1]
        records[record + BLUE], records[record + DEPTH] = colour_gain * colours[3 * i + 2], 0.0
        records[record + REACH] = log2_scale * max_distance * max_distance - MARGIN
        records[record + HALF_X], records[record + HALF_Y] = half_x, half_y
        _write_shape(shapes, i, r0, ring_width, cutoff, k, arcs)
        # Half a pixel wider than `binning` lists, so that rounding cannot make the bound too low.
        columns = _tiles_along(x, half_x + 0.5, width, TILE_SHIFT_X)
        keys[i], max_tiles[i] = i, columns * _tiles_along(y, half_y + 0.5, height, TILE_SHIFT_Y)
    for chunk in range(chunk_max_tiles.size):
        end = min(chunk * CHUNK + CHUNK, max_tiles.size)
        chunk_max_tiles[chunk] = exclusive_sum(max_tiles, chunk * CHUNK, end, first_slots)


@inlined
def _write_shape(shapes, i, r0, ring_width, cutoff, k, arcs):
    """Write the shape of Gaussian i: radius and width of its ring, cutoff (log2), and its arc's b and m, over
    ln 2 and in the record's coordinates u and d_y.

    k: of the record; arcs (n 3): flat, empty if there are none."""
    shape = i * SHAPE
    shapes[shape + R0], shapes[shape + WIDTH] = r0, ring_width
    shapes[shape + SHARPNESS] = 0.5 / (math.log(2.0) * ring_width * ring_width)
    shapes[shape + CUTOFF] = cutoff + MARGIN
    if arcs.size > 0:
        b_x, b_y, m = np.float64(arcs[3 * i]), np.float64(arcs[3 * i + 1]), np.float64(arcs[3 * i + 2])
        shapes[shape + ARC_U], shapes[shape + ARC_Y] = b_x / math.log(2.0), (b_y - k * b_x) / math.log(2.0)
        shapes[shape + ARC_NORM] = m / math.log(2.0)


# --- profiles --------------------------------------------------------------------------------------------


@inlined
def _row_start(records, record, left, y):
    """Return u at column `left` and d_y in the pixel row y, and k, the step of u from row to row; all float64."""
    dy = y + 0.5 - np.float64(load_scalar(records, record + Y))
    k = np.float64(load_scalar(records, record + K)) + np.float64(load_scalar(records, record + K_REST))
    return left + 0.5 - np.float64(load_scalar(records, record + X)) + k * dy, dy, k


@inlined
def _distance(records, record, u, dy):
    """Return the Mahalanobis distance r = sqrt(-2 ln 2 (A u² + D d_y²)), at least RADIUS_MIN."""
    power = fma(u * load_scalar(records, record + A), u, load_scalar(records, record + D) * dy * dy)
    return sqrt(maximum(power * -TWO_LN2, RADIUS2_MIN))


@inlined
def _negative_log2_profile(shapes, shape, radial_offset, u, dy, arcs):
    """Return -log2 G. shape: index of the Gaussian's first number in `shapes`; radial_offset = r - r0; arcs: whether
    there are arcs."""
    if not arcs:
        return radial_offset * radial_offset * load_scalar(shapes, shape + SHARPNESS)
    level = load_scalar(shapes, shape + ARC_NORM) - load_scalar(shapes, shape + ARC_Y) * dy
    arc_term = level - u * load_scalar(shapes, shape + ARC_U)
    return fma(radial_offset * radial_offset, load_scalar(shapes, shape + SHARPNESS), arc_term)


# --- forward ---------------------------------------------------------------------------------------------


@inlined
def _add_row(state, state_row, e, records, record):
    """Add one row of a Gaussian to the sums of a tile. state_row: index of the row's first number in the state; e:
    the profile G at the row's 16 pixels."""
    e = where(e >= PROFILE_MIN, e, ZERO)
    store(state, state_row + RED_PLANE, fma(e, load_scalar(records, record + RED), load(state, state_row + RED_PLANE)))
    green, blue = load(state, state_row + GREEN_PLANE), load(state, state_row + BLUE_PLANE)
    store(state, state_row + GREEN_PLANE, fma(e, load_scalar(records, record + GREEN), green))
    store(state, state_row + BLUE_PLANE, fma(e, load_scalar(records, record + BLUE), blue))


@inlined
def _add_plain(state, records, record, left, top, first_row, end_row, run_start):
    """Add a plain Gaussian to rows first_row .. end_row - 1, by the recurrence unless it is a needle (see
    `raster_forward`). The opacity in its record is 1."""
    step, opaque_one = load_scalar(records, record + STEP), opaque(1)  # opaque: the loop is not unrolled
    is_narrow, run = is_needle(records, record, end_row - first_row), run_length(records, record)
    e, r, _ = run_start
    row, run_end = first_row, first_row if is_narrow else min(first_row + run, end_row)
    while True:
        while row < run_end:
            _add_row(state, row * ROW, e, records, record)
            e = e * r
            r = fma(r, step, r)
            row += opaque_one
        if row >= end_row:
            break
        u, dy = needle_offsets(records, record, left, top + row)
        e, r = falloff(records, record, u, dy), row_ratio(records, record, u, dy)
        run_end = row + 1 if is_narrow else min(row + run, end_row)


@inlined
def _draw_shaped(state, records, record, shapes, shape, left, top, first_row, end_row, arcs, add):
    """Draw a ring or arc in rows first_row .. end_row - 1 of a tile; rows that it does not reach cost little.

    shape: index of the Gaussian's first number in `shapes`. left, top: corner of the tile, px. arcs: whether there are
    arcs. add: the blend is "add", else "over".
    """
    lane0_u, row_dy, k = _row_start(records, record, left, top + first_row)
    r0, cutoff = load_scalar(shapes, shape + R0), load_scalar(shapes, shape + CUTOFF)
    row, opaque_one = first_row, opaque(1)  # opaque: the loop is not unrolled
    while row < end_row:
        dy, u = np.float32(row_dy), lane_index() + np.float32(lane0_u)
        power = _negative_log2_profile(shapes, shape, _distance(records, record, u, dy) - r0, u, dy, arcs)
        if any_of(power <= cutoff):
            e = exp2(-power)
            if add:
                _add_row(state, row * ROW, e, records, record)
            else:
                blend_row(state, row * ROW, e * load_scalar(records, record + OPACITY), records, record, False)
        row += opaque_one
        lane0_u += k
        row_dy += 1.0


@inlined
def _draw_plain_tile(entries, begin, end, records, left, top, state):
    """Draw entries begin .. end - 1 of a tile: plain Gaussians, blend "add"."""
    if begin == end:
        return
    upcoming = next_entry(entries, begin, end, records, left, top)
    for index in range(begin, end):
        record, first_row, end_row, run_start = upcoming
        upcoming = next_entry(entries, index + 1, end, records, left, top)
        _add_plain(state, records, record, left, top, first_row, end_row, run_start)


@inlined
def _draw_shaped_tile(entries, begin, end, records, shapes, left, top, state, arcs, add):
    """Draw entries begin .. end - 1 of a tile, rings or arcs, until all pixels are finished; return the end of the
    drawn ones."""
    for index in range(begin, end):
        if not add and (index - begin) & (CHECK_INTERVAL - 1) == CHECK_INTERVAL - 1 and is_finished(state):
            return index
        i = load_scalar(entries, index * ENTRY + GAUSSIAN)
        first_row = load_scalar(entries, index * ENTRY + FIRST_ROW)
        end_row = load_scalar(entries, index * ENTRY + END_ROW)
        _draw_shaped(state, records, i * RECORD, shapes, i * SHAPE, left, top, first_row, end_row, arcs, add)
    return end


@kernel
def raster(
    counter, state, entries, starts, records, shapes, background, width, height, tiles_x, shaped, arcs, add,
    image, alphas, ends,
):  # fmt: skip
    """Write colour and alpha of all tiles; ends (tiles,): the end of each tile's drawn entries.

    shaped: there are rings or arcs, else plain Gaussians, which this kernel draws with the blend "add" only; arcs:
    there are arcs; add: the blend is "add", else "over"; counter: index of the next tile; state: workspace of a tile;
    starts (tiles + 1,): index of each tile's first entry."""
    no_depth = np.bool_(False)
    while True:
        tile = atomic_increment(counter)
        if tile >= ends.size:
            break
        left, top = (tile % tiles_x) * TILE_WIDTH, (tile // tiles_x) * TILE_HEIGHT
        begin, end = starts[tile], starts[tile + 1]
        init_tile(state, ROW, left, top, width, height)
        if not shaped:
            _draw_plain_tile(entries, begin, end, records, left, top, state)
        elif add:  # the same call twice: LLVM compiles each for its value of add
            end = _draw_shaped_tile(entries, begin, end, records, shapes, left, top, state, arcs, add)
        else:
            end = _draw_shaped_tile(entries, begin, end, records, shapes, left, top, state, arcs, add)
        ends[tile] = end
        # alphas stand for the depths, which are not written
        write_tile(image, alphas, alphas, alphas, state, left, top, width, height, background, no_depth)


# --- backward --------------------------------------------------------------------------------------------


@inlined
def _add_gradient(state, state_row, e, records, record):
    """Return g and w of one row for the blend "add", where Gaussians are independent: w = G, g = w v . colour.

    v: gradient of the pixels' colours; state_row: index of the row's first number in the state."""
    w = where(e >= PROFILE_MIN, e, ZERO)
    vc = load(state, state_row + V_RED) * load_scalar(records, record + RED)
    vc = fma(load(state, state_row + V_GREEN), load_scalar(records, record + GREEN), vc)
    return w * fma(load(state, state_row + V_BLUE), load_scalar(records, record + BLUE), vc), w


@inlined
def _add_colours(state, state_row, w, colours):
    """Return the sums for red, green and blue with w v added; v: gradient of the pixels' colours in this row."""
    return (
        fma(w, load(state, state_row + V_RED), colours[0]),
        fma(w, load(state, state_row + V_GREEN), colours[1]),
        fma(w, load(state, state_row + V_BLUE), colours[2]),
    )


@inlined
def _add_moments(sums, h, u, dy):
    """Add h times u, d_y, u², u d_y, d_y² to the sums."""
    hu, hy = h * u, h * dy
    return sums[0] + hu, sums[1] + hy, fma(hu, u, sums[2]), fma(hu, dy, sums[3]), fma(hy, dy, sums[4])


@inlined
def _needle_backward(state, records, record, left, top, first_row, end_row):
    """Return the gradient row of a needle, blend "add": sums of g times u, d_y, u², u d_y, d_y², a zero, then the sums
    for red, green and blue.

    A needle is a plain Gaussian too narrow for the recurrence over rows, so each row has its own exponential."""
    zero = splat(ZERO)
    sums, colours = (zero, zero, zero, zero, zero), (zero, zero, zero)
    row, opaque_one = first_row, opaque(1)  # opaque: the loop is not unrolled
    while row < end_row:
        u, dy = needle_offsets(records, record, left, top + row)
        g, w = _add_gradient(state, row * ROW_BACKWARD, falloff(records, record, u, dy), records, record)
        colours = _add_colours(state, row * ROW_BACKWARD, w, colours)
        sums = _add_moments(sums, g, u, dy)
        row += opaque_one
    return reduce_add_each((sums[0], sums[1], sums[2], sums[3], sums[4], zero, colours[0], colours[1], colours[2]))


@inlined
def _plain_backward(state, records, record, left, top, first_row, end_row, run_start):
    """Return the gradient row of a plain Gaussian that is no needle, blend "add", in the form of `_needle_backward`.

    e follows the recurrence over rows (head of `raster_forward`), with the ratio r of one row to the row before. Each
    lane sums g, g d_y and g d_y², from which `moments` computes the five moments."""
    step, opaque_one, run = load_scalar(records, record + STEP), opaque(1), run_length(records, record)  # not unrolled
    zero = splat(ZERO)
    m0, m1, m2, colours = zero, zero, zero, (zero, zero, zero)
    e, r, dy = run_start
    row, run_end = first_row, min(first_row + run, end_row)
    while True:
        while row < run_end:
            g, w = _add_gradient(state, row * ROW_BACKWARD, e, records, record)
            colours = _add_colours(state, row * ROW_BACKWARD, w, colours)
            gy = g * dy
            m0, m1, m2 = m0 + g, m1 + gy, fma(gy, dy, m2)
            dy += ONE
            e = e * r
            r = fma(r, step, r)
            row += opaque_one
        if row >= end_row:
            break
        e, r, dy = start_run(records, record, left, top + row)
        run_end = min(row + run, end_row)
    mu, my, muu, muy, myy = moments(records, record, left, m0, m1, m2)
    return reduce_add_each((mu, my, muu, muy, myy, zero, colours[0], colours[1], colours[2]))


@inlined
def _shaped_backward(state, records, record, shapes, shape, left, top, first_row, end_row, arcs, add):
    """Return the gradient row of a ring or arc, summed over rows of a tile: the moments of h, the sums of g and of the
    colours, the gradients of r0 and w, and the sums of g u and g d_y, from which the gradient of b follows.

    The module head explains these letters. shape: index of the Gaussian's first number in `shapes`. left, top: corner
    of the tile, px. first_row, end_row: rows of the tile, the last one excluded. arcs: whether there are arcs. add: the
    blend is "add", else "over".
    """
    lane0_u, row_dy, k = _row_start(records, record, left, top + first_row)
    r0, cutoff = load_scalar(shapes, shape + R0), load_scalar(shapes, shape + CUTOFF)
    zero = splat(ZERO)
    sums, colours, g_sum = (zero, zero, zero, zero, zero), (zero, zero, zero), zero
    d_r0, d_w, arc_u, arc_y = zero, zero, zero, zero
    row, opaque_one = first_row, opaque(1)  # opaque: the loop is not unrolled
    while row < end_row:
        dy, u = np.float32(row_dy), lane_index() + np.float32(lane0_u)
        r = _distance(records, record, u, dy)
        z = r - r0
        power = _negative_log2_profile(shapes, shape, z, u, dy, arcs)
        if any_of(power <= cutoff):
            e = exp2(-power)
            if add:
                g, w = _add_gradient(state, row * ROW_BACKWARD, e, records, record)
            else:
                e = e * load_scalar(records, record + OPACITY)
                g, w = row_gradient(state, row * ROW_BACKWARD, e, records, record, False)
            colours = _add_colours(state, row * ROW_BACKWARD, w, colours)
            g_sum = g_sum + g
            gz = g * z
            d_r0, d_w = d_r0 + gz, fma(gz, z, d_w)
            sums = _add_moments(sums, where(r > RADIUS_MIN, gz / r, ZERO), u, dy)
            if arcs:
                arc_u, arc_y = fma(g, u, arc_u), fma(g, dy, arc_y)
        row += opaque_one
        lane0_u += k
        row_dy += 1.0
    inverse_w2 = load_scalar(shapes, shape + SHARPNESS) * TWO_LN2
    return reduce_add_each((
        sums[0] * inverse_w2, sums[1] * inverse_w2, sums[2] * inverse_w2, sums[3] * inverse_w2, sums[4] * inverse_w2,
        g_sum,
        colours[0], colours[1], colours[2], d_r0 * inverse_w2, d_w * (inverse_w2 / load_scalar(shapes, shape + WIDTH)),
        arc_u, arc_y,
    ))  # fmt: skip


@inlined
def _plain_tile_backward(entries, begin, end, records, left, top, state, gradients):
    """Write the gradient rows of a tile's entries begin .. end - 1: plain Gaussians, blend "add"."""
    if begin == end:
        return
    upcoming = next_entry(entries, begin, end, records, left, top)
    for index in range(begin, end):
        record, first_row, end_row, run_start = upcoming
        upcoming = next_entry(entries, index + 1, end, records, left, top)
        prefetch(gradients, load_scalar(entries, min(index + PREFETCH_DISTANCE, end - 1) * ENTRY + SLOT) * RECORD)
        if is_needle(records, record, end_row - first_row):
            gradient_row = _needle_backward(state, records, record, left, top, first_row, end_row)
        else:
            gradient_row = _plain_backward(state, records, record, left, top, first_row, end_row, run_start)
        store(gradients, load_scalar(entries, index * ENTRY + SLOT) * RECORD, gradient_row)


@inlined
def _shaped_tile_backward(entries, begin, drawn_end, end, records, shapes, left, top, state, arcs, add, gradients):
    """Write the gradient rows of a tile's entries begin .. end - 1, rings or arcs; zeros from drawn_end on, which were
    not drawn."""
    for index in range(begin, drawn_end):
        prefetch(gradients, load_scalar(entries, min(index + PREFETCH_DISTANCE, end - 1) * ENTRY + SLOT) * RECORD)
        i = load_scalar(entries, index * ENTRY + GAUSSIAN)
        first_row = load_scalar(entries, index * ENTRY + FIRST_ROW)
        end_row = load_scalar(entries, index * ENTRY + END_ROW)
        gradient_row = _shaped_backward(
            state, records, i * RECORD, shapes, i * SHAPE, left, top, first_row, end_row, arcs, add
        )
        store(gradients, load_scalar(entries, index * ENTRY + SLOT) * RECORD, gradient_row)
    for index in range(drawn_end, end):
        store(gradients, load_scalar(entries, index * ENTRY + SLOT) * RECORD, splat(ZERO))


@kernel
def raster_backward(
    counter, scratch, entries, starts, ends, records, shapes, background, width, height, tiles_x, shaped, arcs, add,
    image, alphas, d_image, d_alphas, gradients,
):  # fmt: skip
    """Write the gradient row of each slot, RECORD numbers, to `gradients`. d_alphas may be empty.

    shaped: there are rings or arcs; arcs: there are arcs; add: the blend is "add", else "over"; counter: index of the
    next tile; scratch: workspace of SCRATCH numbers; starts (tiles + 1,): index of each tile's first entry; ends
    (tiles,): end of its drawn entries."""
    state, padded = scratch[:STATE_BACKWARD], scratch[STATE_BACKWARD:SCRATCH].reshape(6, PADDED_ROW)
    no_depth = np.bool_(False)
    while True:
        tile = atomic_increment(counter)
        if tile >= ends.size:
            break
        left, top = (tile % tiles_x) * TILE_WIDTH, (tile // tiles_x) * TILE_HEIGHT
        begin, drawn_end, end = starts[tile], ends[tile], starts[tile + 1]
        init_tile_backward(  # alphas and d_alphas stand for the depths, which are not read
            state, left, top, width, height, background, image, alphas, alphas, d_image, d_alphas, d_alphas,
            no_depth, padded,
        )  # fmt: skip
        if not shaped:
            _plain_tile_backward(entries, begin, end, records, left, top, state, gradients)
        elif add:  # the same call twice: LLVM compiles each for its value of add
            _shaped_tile_backward(
                entries, begin, drawn_end, end, records, shapes, left, top, state, arcs, add, gradients
            )
        else:
            _shaped_tile_backward(
                entries, begin, drawn_end, end, records, shapes, left, top, state, arcs, add, gradients
            )


@inlined
def _write_row_sum(gradients, first_slot, count, row):
    """Write the sum of `count` gradient rows, from first_slot on, to `row` (16,)."""
    total = splat(ZERO)
    for slot in range(first_slot, first_slot + count):
        total = total + load(gradients, slot * RECORD)
    store(row, 0, total)


@kernel
def sum_gradients(
    row, covariances, opacities, colours, arcs, gradients, first_slots, counts, add,
    d_centres, d_covariances, d_opacities, d_colours, d_rings, d_arcs,
):  # fmt: skip
    """Write the gradients of the inputs (d_...) from the gradient rows, sums of g and its moments (`layout`).

    row: workspace of 16; covariances, opacities, colours, arcs: the flat inputs; gradients: the rows, by slot;
    first_slots, counts: first slot and number of slots of each Gaussian; add: the blend is "add". d_rings, d_arcs may
    be empty."""
    for i in range(opacities.size):
        _write_row_sum(gradients, first_slots[i], counts[i], row)
        xx, xy = np.float64(covariances[3 * i]), np.float64(covariances[3 * i + 1])
        yy = np.float64(covariances[3 * i + 2])
        determinant = xx * yy - xy * xy
        if not (determinant > 0 and yy > 0):
            determinant, yy = 1.0, 1.0  # such a Gaussian was not drawn: all its sums are 0
        # The formulas of `_gradients_from_moments` in `projection`, in float64; alpha = yy / det.
        k, alpha, inverse = -xy / yy, yy / determinant, 1.0 / yy
        uu, uy, dd = alpha * row[G_UU], inverse * row[G_UY], inverse * inverse * row[G_YY]
        d_centres[2 * i] = alpha * row[G_U]
        d_centres[2 * i + 1] = alpha * k * row[G_U] + inverse * row[G_Y]
        d_covariances[3 * i] = 0.5 * alpha * uu
        d_covariances[3 * i + 1] = alpha * (k * uu + uy)
        d_covariances[3 * i + 2] = 0.5 * (alpha * k * k * uu + 2.0 * alpha * k * uy + dd)
        colour_sums = (row[G_RED], row[G_GREEN], row[G_BLUE])
        if add:
            d_opacities[i] = ZERO
            for c in range(3):
                d_opacities[i] += colour_sums[c] * colours[3 * i + c]
                d_colours[3 * i + c] = colour_sums[c] * opacities[i]
        else:
            is_unclamped = ALPHA_MIN <= opacities[i] <= OPACITY_MAX
            d_opacities[i] = row[G] / opacities[i] if is_unclamped else ZERO
            for c in range(3):
                d_colours[3 * i + c] = colour_sums[c]
        if d_rings.size > 0:
            d_rings[2 * i], d_rings[2 * i + 1] = row[G_R0], row[G_WIDTH]
        if d_arcs.size > 0:
            # b·d depends on the centre; d_x = u - k d_y.
            d_centres[2 * i] -= row[G] * arcs[3 * i]
            d_centres[2 * i + 1] -= row[G] * arcs[3 * i + 1]
            d_arcs[3 * i], d_arcs[3 * i + 1] = row[G_ARC_U] - k * row[G_ARC_Y], row[G_ARC_Y]
            d_arcs[3 * i + 2] = -row[G]
