# SPDX-License-Identifier: GPL-3.0-or-later
"""Rasterizes records front to back, tile by tile; called by `scene` and `splats`.

One vector is a row of a tile. For the rows of an entry, with e = opacity 2^(A u² + D d_y²) (see `projection`):

    alpha = e where e >= 1/255 and T >= 1e-4, else 0
    w = T alpha,   picture = picture + w colour,   T = T - w

From row to row e follows a recurrence instead of an exponential: e' = e r, r' = r + r step, where
r = 2^(A (2 u k + k²) + D (2 d_y + 1)) and step = 2^(2 (A k² + D)) - 1, which is small and exact for large Gaussians.
The recurrence restarts after `run` rows, over which e changes by 40 powers of two, so that neither underflow nor
rounding spoils it. Where runs would be too short (needles), e is computed for each row.

Arguments of the functions here and in `raster_backward` and `flare`: records, at (or record): the records, and the
offset of the Gaussian's; left, top: first pixel column and row of the tile; first, end: the rows of the tile from
`first` to before `end`; state: the tile's workspace; start: e, r and d_y in row `first`, from `start_run`.
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
def offsets(records, at, left, y):
    """Return u at the 16 pixels from column `left` on of the pixel row y, and d_y."""
    dy = np.float32(y) + HALF - load_scalar(records, at + Y)
    dx = lane_index() + (np.float32(left) + HALF - load_scalar(records, at + X))
    return dx + load_scalar(records, at + K) * dy, dy


@inlined
def needle_offsets(records, at, left, y):
    """Return the same u and d_y, computed in float64 for needles, where u is a small sum of large numbers."""
    dy = y + 0.5 - np.float64(load_scalar(records, at + Y))
    k = np.float64(load_scalar(records, at + K)) + np.float64(load_scalar(records, at + K_REST))
    u = left + 0.5 - np.float64(load_scalar(records, at + X)) + k * dy
    return lane_index() + np.float32(u), np.float32(dy)


@inlined
def falloff(records, at, u, dy):
    """Return 2^(A u² + D d_y²), flushed to 0 below 2^-126."""
    power = fma(u * load_scalar(records, at + A), u, load_scalar(records, at + D) * dy * dy)
    return where(power > POWER_MIN, exp2_unclamped(power), ZERO)


@inlined
def ratio(records, at, u, dy):
    """Return r, the factor of e from this row to the next; `exp2` clamps it only where rows are zero anyway."""
    k, slope = load_scalar(records, at + K), load_scalar(records, at + A) * load_scalar(records, at + K)
    constant = slope * k + load_scalar(records, at + D) * (TWO * dy + ONE)
    return exp2(fma(u, TWO * slope, constant))


@inlined
def run_length(records, at):
    """Return the number of rows of a run."""
    return int(load_scalar(records, at + RUN))


@inlined
def is_needle(records, at, rows):
    """Return whether successive rows differ too much for the recurrence; never if all `rows` fit in one run."""
    run = run_length(records, at)
    return run < rows and run < MIN_RUN


@inlined
def start_tile(state, row_length, left, top, width, height):
    """Set transmittance to 1 inside the picture and to 0 outside, so that no work is done there; all else to 0.

    row_length: numbers of a row of the state."""
    at, line = 0, opaque(TILE_WIDTH)
    while at < row_length * TILE_HEIGHT:
        store(state, at, splat(ZERO))
        at += line
    x = lane_index() + np.float32(left)
    inside = where(x < np.float32(width), splat(ONE), ZERO)
    row, one = 0, opaque(1)
    while row < TILE_HEIGHT:
        store(state, T_PLANE + row * row_length, inside if top + row < height else splat(ZERO))
        row += one


@inlined
def is_finished(state):
    """Return whether the transmittance of all pixels is below the threshold."""
    highest = load(state, T_PLANE)
    for row in range(1, TILE_HEIGHT):
        t = load(state, T_PLANE + row * ROW)
        highest = where(t > highest, t, highest)
    return not any_of(highest >= T_MIN)


@inlined
def blend_row(state, at, e, records, record, with_depth):
    """Blend one row of a Gaussian. at: offset of the row in the state; e: opacity times profile."""
    t = load(state, at + T_PLANE)
    alpha = where((e >= ALPHA_MIN) & (t >= T_MIN), e, ZERO)
    w = t * alpha
    after = t - w
    store(state, at + T_PLANE, after)
    store(state, at + RED_PLANE, fma(w, load_scalar(records, record + RED), load(state, at + RED_PLANE)))
    store(state, at + GREEN_PLANE, fma(w, load_scalar(records, record + GREEN), load(state, at + GREEN_PLANE)))
    store(state, at + BLUE_PLANE, fma(w, load_scalar(records, record + BLUE), load(state, at + BLUE_PLANE)))
    if with_depth:
        depth = load_scalar(records, record + DEPTH)
        store(state, at + DEPTH_PLANE, fma(w, depth, load(state, at + DEPTH_PLANE)))
        passes = (t >= HALF) & (after < HALF)
        store(state, at + MEDIAN_PLANE, where(passes, depth, load(state, at + MEDIAN_PLANE)))


@inlined
def start_run(records, at, left, y):
    """Return e and r (see the module head) in the pixel row y, and d_y."""
    u, dy = offsets(records, at, left, y)
    return falloff(records, at, u, dy) * load_scalar(records, at + OPACITY), ratio(records, at, u, dy), dy


@inlined
def next_entry(entries, e, end, records, left, top):
    """Return offset of the record, first row, end row and start of entry number e; of the last entry if e lies beyond.

    Called before the previous entry is drawn, to hide the latency of the exponentials."""
    at_entry = min(e, end - 1) * ENTRY
    prefetch(records, load_scalar(entries, min(e + PREFETCH_DISTANCE, end - 1) * ENTRY + GAUSSIAN) * RECORD)
    at = load_scalar(entries, at_entry + GAUSSIAN) * RECORD
    first = load_scalar(entries, at_entry + FIRST_ROW)
    return at, first, load_scalar(entries, at_entry + END_ROW), start_run(records, at, left, top + first)


@inlined
def _blend_needle(state, records, at, left, top, first, end, with_depth):
    """Blend a Gaussian into rows first .. end of the tile, with an exponential for each row."""
    row, one = first, opaque(1)
    while row < end:
        u, dy = needle_offsets(records, at, left, top + row)
        e = falloff(records, at, u, dy) * load_scalar(records, at + OPACITY)
        blend_row(state, row * ROW, e, records, at, with_depth)
        row += one


@inlined
def _blend(state, records, at, left, top, first, end, start, with_depth):
    """Blend a Gaussian into rows first .. end of the tile by the recurrence."""
    step, one, run = load_scalar(records, at + STEP), opaque(1), run_length(records, at)
    e, r, _ = start
    row, stop = first, min(first + run, end)
    while True:
        while row < stop:
            blend_row(state, row * ROW, e, records, at, with_depth)
            e = e * r
            r = fma(r, step, r)
            row += one
        if row >= end:
            break
        e, r, _ = start_run(records, at, left, top + row)
        stop = min(row + run, end)


@inlined
def _copy(source, at, target, to, count):
    """Copy the first `count` of a vector's 16 numbers: all if count is larger, none if it is negative."""
    if count >= TILE_WIDTH:
        store(target, to, load(source, at))
        return
    lane, one = 0, opaque(1)
    while lane < count:
        target[to + lane] = source[at + lane]
        lane += one


@inlined
def write_tile(image, alphas, depths, medians, state, left, top, width, height, background, with_depth):
    """Write the finished tile, over the background, to the flat pictures; overwrites the state."""
    visible_columns = width - left
    row, one = 0, opaque(1)
    while row < min(TILE_HEIGHT, height - top):
        at, pixel = row * ROW, (top + row) * width + left
        t = load(state, at + T_PLANE)
        alpha = ONE - t
        red = fma(t, load_scalar(background, 0), load(state, at + RED_PLANE))
        green = fma(t, load_scalar(background, 1), load(state, at + GREEN_PLANE))
        blue = fma(t, load_scalar(background, 2), load(state, at + BLUE_PLANE))
        store(state, at + T_PLANE, alpha)
        store_rows(state, at + RED_PLANE, TILE_WIDTH, interleave((red, green, blue)))
        _copy(state, at + T_PLANE, alphas, pixel, visible_columns)
        third = 0  # offset of the first, second or third vector of interleaved colours
        while third < 3 * TILE_WIDTH:
            _copy(state, at + RED_PLANE + third, image, 3 * pixel + third, 3 * visible_columns - third)
            third += one * TILE_WIDTH
        if with_depth:
            depth = load(state, at + DEPTH_PLANE) / where(alpha > DEPTH_ALPHA_MIN, alpha, DEPTH_ALPHA_MIN)
            store(state, at + DEPTH_PLANE, depth)
            _copy(state, at + DEPTH_PLANE, depths, pixel, visible_columns)
            _copy(state, at + MEDIAN_PLANE, medians, pixel, visible_columns)
        row += one


@inlined
def _raster_tile(entries, begin, end, records, left, top, state, with_depth):
    """Draw entries begin .. end of a tile until all pixels are finished; return the end of the drawn entries."""
    if begin == end:
        return end
    upcoming = next_entry(entries, begin, end, records, left, top)
    for e in range(begin, end):
        if (e - begin) & (CHECK_INTERVAL - 1) == CHECK_INTERVAL - 1 and is_finished(state):
            return e
        at, first, last, start = upcoming
        upcoming = next_entry(entries, e + 1, end, records, left, top)
        if is_needle(records, at, last - first):
            _blend_needle(state, records, at, left, top, first, last, with_depth)
        else:
            _blend(state, records, at, left, top, first, last, start, with_depth)
    return end


@kernel
def raster(
    counter, state, entries, starts, records, background, width, height, tiles_x, image, alphas, depths, medians, ends
):  # fmt: skip
    """Write colour (h w 3) and alpha (h w), flat; mean and median depth too unless `depths` is empty.

    state: workspace of STATE numbers; starts (tiles + 1,): number of each tile's first entry; ends (tiles,): the end of
    each tile's drawn entries, written for the backward pass.
    """
    with_depth = depths.size > 0
    while True:
        tile = atomic_increment(counter)
        if tile >= ends.size:
            break
        left, top = (tile % tiles_x) * TILE_WIDTH, (tile // tiles_x) * TILE_HEIGHT
        begin, end = starts[tile], starts[tile + 1]
        start_tile(state, ROW, left, top, width, height)
        if with_depth:  # two loops for LLVM to specialise
            ends[tile] = _raster_tile(entries, begin, end, records, left, top, state, with_depth)
        else:
            ends[tile] = _raster_tile(entries, begin, end, records, left, top, state, with_depth)
        write_tile(image, alphas, depths, medians, state, left, top, width, height, background, with_depth)
