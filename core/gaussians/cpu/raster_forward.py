# SPDX-License-Identifier: GPL-3.0-or-later
"""Rasterizes records front to back, tile by tile; called by `scene` and `splats`.

One vector is a row of a tile. For the rows of an entry, with e = opacity 2^(A u² + D d_y²) (see `projection`):

    alpha = e where e >= 1/255 and T >= 1e-4, else 0
    w = T alpha,   picture = picture + w colour,   T = T - w

From row to row e follows a recurrence instead of an exponential: e' = e r, r' = r + r step, where
r = 2^(A (2 u k + k²) + D (2 d_y + 1)) and step = 2^(2 (A k² + D)) - 1, which is small and exact for large Gaussians.
The recurrence restarts after `run` rows, over which e changes by 40 powers of two, so that neither underflow nor
rounding spoils it. Where runs would be too short (needles), e is computed for each row.

Arguments here and in `raster_backward` and `flare`:

    records, record      the records, and the index of the Gaussian's first number in them
    left, top            first pixel column and row of the tile
    first_row, end_row   rows of the tile that the Gaussian covers: its first, and the one after its last
    state                the tile's workspace, ROW numbers for each of its rows
    run_start            e, r and d_y in the first row, from `start_run`
    entries, begin, end  the entries of all tiles (`layout`); those of the tile are numbers begin .. end - 1
    width, height        size of the picture, px
    tiles_x              number of tiles in a row of them
    background           (3,) colour behind all Gaussians
    image, alphas        the pictures, flat: colour (h w 3), alpha (h w)
    depths, medians      mean and median depth, flat (h w); neither read nor written unless `with_depth`
    d_image, ...         the gradients of the pictures
"""
from __future__ import annotations

import numpy as np

from .. import rendering
from .compilation import inlined, kernel
from .layout import (
    ALPHA_MIN,
    BLUE,
    DEPTH,
    END_ROW,
    ENTRY,
    FIRST_ROW,
    GAUSSIAN,
    GREEN,
    HALF,
    K_REST,
    ONE,
    OPACITY,
    RECORD,
    RED,
    RUN,
    STEP,
    T_MIN,
    TILE_HEIGHT,
    TILE_WIDTH,
    TWO,
    ZERO,
    A,
    D,
    K,
    X,
    Y,
)
from .vector import (
    any_of,
    atomic_increment,
    exp2,
    exp2_unclamped,
    fma,
    interleave,
    lane_index,
    load,
    load_scalar,
    opaque,
    prefetch,
    splat,
    store,
    store_rows,
    where,
)

MIN_RUN = 4
"""Rows below which a run costs more than an exponential for each row."""
CHECK_INTERVAL = 32
"""Entries between two checks whether all pixels of the tile are finished."""
PREFETCH_DISTANCE = 6
"""Entries by which records are prefetched ahead."""
POWER_MIN = np.float32(-126)
DEPTH_ALPHA_MIN = np.float32(rendering.ALPHA_MIN / 2)
# The state of a tile, row by row: the vectors of a row.
T_PLANE, RED_PLANE, GREEN_PLANE, BLUE_PLANE, DEPTH_PLANE, MEDIAN_PLANE = (i * TILE_WIDTH for i in range(6))
ROW = 7 * TILE_WIDTH  # an odd number of cache lines, so that rows fall into all sets of the cache
STATE = ROW * TILE_HEIGHT


@inlined
def offsets(records, record, left, y):
    """Return u at the 16 pixels from column `left` on of the pixel row y, and d_y."""
    dy = np.float32(y) + HALF - load_scalar(records, record + Y)
    dx = lane_index() + (np.float32(left) + HALF - load_scalar(records, record + X))
    return dx + load_scalar(records, record + K) * dy, dy


@inlined
def needle_offsets(records, record, left, y):
    """Return the u and d_y of `offsets`, computed in float64 for needles, where u is a small sum of large numbers."""
    dy = y + 0.5 - np.float64(load_scalar(records, record + Y))
    k = np.float64(load_scalar(records, record + K)) + np.float64(load_scalar(records, record + K_REST))
    u = left + 0.5 - np.float64(load_scalar(records, record + X)) + k * dy
    return lane_index() + np.float32(u), np.float32(dy)


@inlined
def falloff(records, record, u, dy):
    """Return 2^(A u² + D d_y²), flushed to 0 below 2^-126."""
    power = fma(u * load_scalar(records, record + A), u, load_scalar(records, record + D) * dy * dy)
    return where(power > POWER_MIN, exp2_unclamped(power), ZERO)


@inlined
def row_ratio(records, record, u, dy):
    """Return r, the factor of e from this row to the next; `exp2` clamps it only where rows are zero anyway."""
    k, slope = load_scalar(records, record + K), load_scalar(records, record + A) * load_scalar(records, record + K)
    constant = slope * k + load_scalar(records, record + D) * (TWO * dy + ONE)
    return exp2(fma(u, TWO * slope, constant))


@inlined
def run_length(records, record):
    """Return the number of rows of a run."""
    return int(load_scalar(records, record + RUN))


@inlined
def is_needle(records, record, rows):
    """Return whether successive rows differ too much for the recurrence; never if all `rows` fit in one run."""
    run = run_length(records, record)
    return run < rows and run < MIN_RUN


@inlined
def init_tile(state, row_stride, left, top, width, height):
    """Set the transmittance of a tile's state to 1 inside the picture and to 0 outside, so that no work is done there;
    all else to 0.

    row_stride: numbers of a row of the state, ROW here or that of `raster_backward`."""
    index, vector_stride = 0, opaque(TILE_WIDTH)  # opaque: the loop is not unrolled
    while index < row_stride * TILE_HEIGHT:
        store(state, index, splat(ZERO))
        index += vector_stride
    x = lane_index() + np.float32(left)
    transmittance_in_frame = where(x < np.float32(width), splat(ONE), ZERO)
    row, opaque_one = 0, opaque(1)  # opaque: the loop is not unrolled
    while row < TILE_HEIGHT:
        store(state, T_PLANE + row * row_stride, transmittance_in_frame if top + row < height else splat(ZERO))
        row += opaque_one


@inlined
def is_finished(state):
    """Return whether the transmittance of all pixels of a tile is below the threshold."""
    max_transmittance = load(state, T_PLANE)
    for row in range(1, TILE_HEIGHT):
        transmittance = load(state, T_PLANE + row * ROW)
        max_transmittance = where(transmittance > max_transmittance, transmittance, max_transmittance)
    return not any_of(max_transmittance >= T_MIN)


@inlined
def blend_row(state, state_row, e, records, record, with_depth):
    """Blend one row of a Gaussian into the state of a tile, and depth too if `with_depth`.

    state_row: index of the row's first number in the state; e: opacity times profile."""
    t = load(state, state_row + T_PLANE)
    alpha = where((e >= ALPHA_MIN) & (t >= T_MIN), e, ZERO)
    w = t * alpha
    t_behind = t - w
    store(state, state_row + T_PLANE, t_behind)
    store(state, state_row + RED_PLANE, fma(w, load_scalar(records, record + RED), load(state, state_row + RED_PLANE)))
    green, blue = load(state, state_row + GREEN_PLANE), load(state, state_row + BLUE_PLANE)
    store(state, state_row + GREEN_PLANE, fma(w, load_scalar(records, record + GREEN), green))
    store(state, state_row + BLUE_PLANE, fma(w, load_scalar(records, record + BLUE), blue))
    if with_depth:
        depth = load_scalar(records, record + DEPTH)
        store(state, state_row + DEPTH_PLANE, fma(w, depth, load(state, state_row + DEPTH_PLANE)))
        crosses_half = (t >= HALF) & (t_behind < HALF)
        store(state, state_row + MEDIAN_PLANE, where(crosses_half, depth, load(state, state_row + MEDIAN_PLANE)))


@inlined
def start_run(records, record, left, y):
    """Return e and r (see the module head) in the pixel row y, and d_y."""
    u, dy = offsets(records, record, left, y)
    e = falloff(records, record, u, dy) * load_scalar(records, record + OPACITY)
    return e, row_ratio(records, record, u, dy), dy


@inlined
def next_entry(entries, index, end, records, left, top):
    """Return the record's index, first row, end row and run_start (e, r and d_y in the first row) of the entry `index`,
    or of the tile's last entry if there are no more.

    end: the index after the tile's last entry. Called before the previous entry is drawn, to hide the latency of the
    exponentials."""
    entry = min(index, end - 1) * ENTRY
    prefetch(records, load_scalar(entries, min(index + PREFETCH_DISTANCE, end - 1) * ENTRY + GAUSSIAN) * RECORD)
    record = load_scalar(entries, entry + GAUSSIAN) * RECORD
    first_row = load_scalar(entries, entry + FIRST_ROW)
    return record, first_row, load_scalar(entries, entry + END_ROW), start_run(records, record, left, top + first_row)


@inlined
def _blend_needle(state, records, record, left, top, first_row, end_row, with_depth):
    """Blend a Gaussian into rows first_row .. end_row - 1 of the tile, with an exponential for each row."""
    row, opaque_one = first_row, opaque(1)  # opaque: the loop is not unrolled
    while row < end_row:
        u, dy = needle_offsets(records, record, left, top + row)
        e = falloff(records, record, u, dy) * load_scalar(records, record + OPACITY)
        blend_row(state, row * ROW, e, records, record, with_depth)
        row += opaque_one


@inlined
def _blend(state, records, record, left, top, first_row, end_row, run_start, with_depth):
    """Blend a Gaussian into rows first_row .. end_row - 1 of the tile by the recurrence."""
    step, opaque_one, run = load_scalar(records, record + STEP), opaque(1), run_length(records, record)  # not unrolled
    e, r, _ = run_start
    row, run_end = first_row, min(first_row + run, end_row)
    while True:
        while row < run_end:
            blend_row(state, row * ROW, e, records, record, with_depth)
            e = e * r
            r = fma(r, step, r)
            row += opaque_one
        if row >= end_row:
            break
        e, r, _ = start_run(records, record, left, top + row)
        run_end = min(row + run, end_row)


@inlined
def _copy_pixels(source, source_index, target, target_index, count):
    """Copy the first `count` of 16 numbers, from an index of the source to an index of the target: all 16 if `count` is
    larger, none if it is negative."""
    if count >= TILE_WIDTH:
        store(target, target_index, load(source, source_index))
        return
    lane, opaque_one = 0, opaque(1)  # opaque: the loop is not unrolled
    while lane < count:
        target[target_index + lane] = source[source_index + lane]
        lane += opaque_one


@inlined
def write_tile(image, alphas, depths, medians, state, left, top, width, height, background, with_depth):
    """Write the finished tile, over the background, to the pictures; overwrites the state."""
    visible_columns = width - left
    row, opaque_one = 0, opaque(1)  # opaque: the loop is not unrolled
    while row < min(TILE_HEIGHT, height - top):
        state_row, pixel = row * ROW, (top + row) * width + left
        t = load(state, state_row + T_PLANE)
        alpha = ONE - t
        red = fma(t, load_scalar(background, 0), load(state, state_row + RED_PLANE))
        green = fma(t, load_scalar(background, 1), load(state, state_row + GREEN_PLANE))
        blue = fma(t, load_scalar(background, 2), load(state, state_row + BLUE_PLANE))
        store(state, state_row + T_PLANE, alpha)
        store_rows(state, state_row + RED_PLANE, TILE_WIDTH, interleave((red, green, blue)))
        _copy_pixels(state, state_row + T_PLANE, alphas, pixel, visible_columns)
        vector_offset = 0  # of the first, second or third vector of interleaved colours
        while vector_offset < 3 * TILE_WIDTH:
            _copy_pixels(
                state, state_row + RED_PLANE + vector_offset, image, 3 * pixel + vector_offset,
                3 * visible_columns - vector_offset,
            )  # fmt: skip
            vector_offset += opaque_one * TILE_WIDTH
        if with_depth:
            depth = load(state, state_row + DEPTH_PLANE) / where(alpha > DEPTH_ALPHA_MIN, alpha, DEPTH_ALPHA_MIN)
            store(state, state_row + DEPTH_PLANE, depth)
            _copy_pixels(state, state_row + DEPTH_PLANE, depths, pixel, visible_columns)
            _copy_pixels(state, state_row + MEDIAN_PLANE, medians, pixel, visible_columns)
        row += opaque_one


@inlined
def _raster_tile(entries, begin, end, records, left, top, state, with_depth):
    """Draw entries begin .. end - 1 of a tile until all pixels are finished; return the end of the drawn entries."""
    if begin == end:
        return end
    upcoming = next_entry(entries, begin, end, records, left, top)
    for index in range(begin, end):
        if (index - begin) & (CHECK_INTERVAL - 1) == CHECK_INTERVAL - 1 and is_finished(state):
            return index
        record, first_row, end_row, run_start = upcoming
        upcoming = next_entry(entries, index + 1, end, records, left, top)
        if is_needle(records, record, end_row - first_row):
            _blend_needle(state, records, record, left, top, first_row, end_row, with_depth)
        else:
            _blend(state, records, record, left, top, first_row, end_row, run_start, with_depth)
    return end


@kernel
def raster(
    counter, state, entries, starts, records, background, width, height, tiles_x, image, alphas, depths, medians, ends
):  # fmt: skip
    """Write colour and alpha of all tiles; mean and median depth too unless `depths` is empty.

    counter: index of the next tile; state: workspace of STATE numbers; starts (tiles + 1,): index of each tile's first
    entry; ends (tiles,): the end of each tile's drawn entries, written for the backward pass. The module head lists the
    others."""
    with_depth = depths.size > 0
    while True:
        tile = atomic_increment(counter)
        if tile >= ends.size:
            break
        left, top = (tile % tiles_x) * TILE_WIDTH, (tile // tiles_x) * TILE_HEIGHT
        begin, end = starts[tile], starts[tile + 1]
        init_tile(state, ROW, left, top, width, height)
        if with_depth:  # the same call twice: LLVM compiles each for its with_depth
            ends[tile] = _raster_tile(entries, begin, end, records, left, top, state, with_depth)
        else:
            ends[tile] = _raster_tile(entries, begin, end, records, left, top, state, with_depth)
        write_tile(image, alphas, depths, medians, state, left, top, width, height, background, with_depth)
