# SPDX-License-Identifier: GPL-3.0-or-later
"""Blends Gaussians front to back, tile by tile.

One vector is a row of a tile. For the rows of an entry, with e = opacity 2^-(A u² + D d_y²) (see `projection`):

    alpha = e where e >= 1/255 and T >= 1e-4, else 0
    w = T alpha,   C = C + w colour,   T = T - w

From row to row e follows a recurrence instead of an exponential each: e' = e r, r' = r step, where
r = 2^-(A (2 u k + k²) + D (2 d_y + 1)). It starts anew every 16 rows; and where rows differ by more than a
few powers of two (`STEEP`: thin needles), it would lose its start below the smallest float, so that e is
computed for each row.
"""
from __future__ import annotations

import numpy as np

from .. import rendering
from .binning import END_ROW, FIRST_ROW, GAUSSIAN, TILE_HEIGHT, TILE_WIDTH
from .compilation import inlined, kernel
from .projection import ALPHA_MIN, BEND, BLUE, DEPTH, GREEN, K_REST, OPACITY, RECORD, RED, STEP, A, D, K, X, Y
from .vector import (
    LANES,
    any_of,
    exp2,
    fma,
    interleave,
    lanes,
    load,
    prefetch,
    splat,
    store,
    store_rows,
    take_number,
    where,
)

T_MIN = np.float32(rendering.TRANSMITTANCE_MIN)
RUN = 16
"""Rows to a run of the recurrence: rounding grows with the square of its length."""
STEEP = np.float32(32.0)
"""Largest C n² (powers of two over n rows) for the recurrence."""
PAUSE = 32
"""Entries between two looks at whether all pixels of the tile are done."""
AHEAD = 6
"""Entries ahead of which records are asked for."""
E_MAX = np.float32(126)
ZERO, HALF, ONE, TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
DEPTH_ALPHA_MIN = np.float32(rendering.ALPHA_MIN / 2)
# The state of a tile: planes of 32 rows of 16.
PLANE = TILE_WIDTH * TILE_HEIGHT
T_PLANE, RED_PLANE, GREEN_PLANE, BLUE_PLANE, DEPTH_PLANE, MEDIAN_PLANE = (i * PLANE for i in range(6))
STATE = 6 * PLANE


@inlined
def offsets(records, at, left, y):  # type: ignore[no-untyped-def]
    """u along the pixel row y of the tile, and d_y. The sum of large numbers that is small near a needle is
    taken in float64."""
    dy = y + 0.5 - np.float64(records[at + Y])
    u = left + 0.5 - np.float64(records[at + X]) + (np.float64(records[at + K]) + np.float64(records[at + K_REST])) * dy
    return lanes() + np.float32(u), np.float32(dy)


@inlined
def falloff(major, minor, u, dy):  # type: ignore[no-untyped-def]
    """2^-(A u² + D d_y²); 0 instead of what is below 2^-126."""
    power = fma(u * major, u, splat(minor * dy * dy))
    return where(power < E_MAX, exp2(-power), ZERO)


@inlined
def ratio(major, k, minor, u, dy):  # type: ignore[no-untyped-def]
    """The factor from this row to the next. Its limit only meets rows of zeros."""
    power = fma(u, -TWO * major * k, splat(-(major * k * k + minor * (TWO * dy + ONE))))
    return exp2(power)


@inlined
def start_tile(state, left, top, width, height):  # type: ignore[no-untyped-def]
    """Transmittance 1 in the picture and 0 outside, where nothing needs to be done."""
    x = lanes() + np.float32(left)
    inside = where(x < np.float32(width), splat(ONE), ZERO)
    for row in range(TILE_HEIGHT):
        store(state, T_PLANE + row * LANES, inside if top + row < height else splat(ZERO))
    for at in range(PLANE, STATE, LANES):
        store(state, at, splat(ZERO))


@inlined
def finished(state):  # type: ignore[no-untyped-def]
    """Whether no pixel takes any more light."""
    most = load(state, T_PLANE)
    for row in range(1, TILE_HEIGHT):
        t = load(state, T_PLANE + row * LANES)
        most = where(t > most, t, most)
    return not any_of(most >= T_MIN)


@inlined
def blend_row(state, at, e, red, green, blue, depth, with_depth):  # type: ignore[no-untyped-def]
    t = load(state, at + T_PLANE)
    alpha = where((e >= ALPHA_MIN) & (t >= T_MIN), e, ZERO)
    w = t * alpha
    after = t - w
    store(state, at + T_PLANE, after)
    store(state, at + RED_PLANE, fma(w, red, load(state, at + RED_PLANE)))
    store(state, at + GREEN_PLANE, fma(w, green, load(state, at + GREEN_PLANE)))
    store(state, at + BLUE_PLANE, fma(w, blue, load(state, at + BLUE_PLANE)))
    if with_depth:
        store(state, at + DEPTH_PLANE, fma(w, depth, load(state, at + DEPTH_PLANE)))
        passes = (t >= HALF) & (after < HALF)
        store(state, at + MEDIAN_PLANE, where(passes, depth, load(state, at + MEDIAN_PLANE)))


@inlined
def _blend(state, records, at, left, top, first, end, with_depth):  # type: ignore[no-untyped-def]
    """One Gaussian over rows first .. end of the tile."""
    major, k, minor = records[at + A], records[at + K], records[at + D]
    opacity, step = records[at + OPACITY], records[at + STEP]
    red, green, blue, depth = records[at + RED], records[at + GREEN], records[at + BLUE], records[at + DEPTH]
    rows = np.float32(min(end - first, RUN))
    if records[at + BEND] * rows * rows > STEEP:
        for row in range(first, end):
            u, dy = offsets(records, at, left, top + row)
            e = falloff(major, minor, u, dy) * opacity
            blend_row(state, row * LANES, e, red, green, blue, depth, with_depth)
        return
    for run in range(first, end, RUN):
        u, dy = offsets(records, at, left, top + run)
        e = falloff(major, minor, u, dy) * opacity
        r = ratio(major, k, minor, u, dy)
        for row in range(run, min(run + RUN, end)):
            blend_row(state, row * LANES, e, red, green, blue, depth, with_depth)
            e = e * r
            r = r * step


@inlined
def _write_row(image, alphas, depths, medians, state, row, left, y, width, background, with_depth):  # type: ignore[no-untyped-def]
    at = row * LANES
    t = load(state, at + T_PLANE)
    pixel = y * width + left
    red = fma(t, background[0], load(state, at + RED_PLANE))
    green = fma(t, background[1], load(state, at + GREEN_PLANE))
    blue = fma(t, background[2], load(state, at + BLUE_PLANE))
    alpha = ONE - t
    if with_depth:
        depth = load(state, at + DEPTH_PLANE) / where(alpha > DEPTH_ALPHA_MIN, alpha, DEPTH_ALPHA_MIN)
        store(state, at + DEPTH_PLANE, depth)
    if left + LANES <= width:
        store_rows(image, 3 * pixel, LANES, interleave((red, green, blue)))
        store(alphas, pixel, alpha)
        if with_depth:
            store(depths, pixel, load(state, at + DEPTH_PLANE))
            store(medians, pixel, load(state, at + MEDIAN_PLANE))
        return
    store(state, at + RED_PLANE, red)
    store(state, at + GREEN_PLANE, green)
    store(state, at + BLUE_PLANE, blue)
    for lane in range(width - left):
        image[3 * (pixel + lane)] = state[at + RED_PLANE + lane]
        image[3 * (pixel + lane) + 1] = state[at + GREEN_PLANE + lane]
        image[3 * (pixel + lane) + 2] = state[at + BLUE_PLANE + lane]
        alphas[pixel + lane] = ONE - state[at + T_PLANE + lane]
        if with_depth:
            depths[pixel + lane] = state[at + DEPTH_PLANE + lane]
            medians[pixel + lane] = state[at + MEDIAN_PLANE + lane]


@inlined
def write_tile(image, alphas, depths, medians, state, left, top, width, height, background, with_depth):  # type: ignore[no-untyped-def]
    """The finished tile into the picture."""
    for row in range(min(TILE_HEIGHT, height - top)):
        _write_row(image, alphas, depths, medians, state, row, left, top + row, width, background, with_depth)


@inlined
def _raster_tile(
    entries, begin, end, records, background, left, top, width, height, state, image, alphas, depths, medians, with_depth
):  # type: ignore[no-untyped-def]  # fmt: skip
    """Draws a tile; returns the end of the entries it needed."""
    start_tile(state, left, top, width, height)
    used = end
    for e in range(begin, end):
        if (e - begin) & (PAUSE - 1) == PAUSE - 1 and finished(state):
            used = e
            break
        prefetch(records, entries[min(e + AHEAD, end - 1), GAUSSIAN] * RECORD)
        at = entries[e, GAUSSIAN] * RECORD
        _blend(state, records, at, left, top, entries[e, FIRST_ROW], entries[e, END_ROW], with_depth)
    write_tile(image, alphas, depths, medians, state, left, top, width, height, background, with_depth)
    return used


@kernel
def raster(
    counter, entries, starts, records, background, width, height, tiles_x, image, alphas, depths, medians, ends
):  # type: ignore[no-untyped-def]  # fmt: skip
    """Colour (h w 3) and alpha (h w), flat; expected and median depth too unless `depths` is empty.

    ends (tiles,): where each tile stopped.
    """
    state = np.empty(STATE, np.float32)
    with_depth = depths.size > 0
    while True:
        tile = take_number(counter)
        if tile >= ends.size:
            break
        left, top = (tile % tiles_x) * TILE_WIDTH, (tile // tiles_x) * TILE_HEIGHT
        if with_depth:
            ends[tile] = _raster_tile(
                entries, starts[tile], starts[tile + 1], records, background, left, top, width, height, state,
                image, alphas, depths, medians, True,
            )  # fmt: skip
        else:
            ends[tile] = _raster_tile(
                entries, starts[tile], starts[tile + 1], records, background, left, top, width, height, state,
                image, alphas, depths, medians, False,
            )  # fmt: skip
