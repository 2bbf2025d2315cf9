# SPDX-License-Identifier: GPL-3.0-or-later
"""L1 and SSIM with their gradient in one pass; the definition is `..loss`.

A picture row is 3 w interleaved numbers (red, green, blue), and neighbours in x are 3 numbers apart, so colours need no
deinterleaving. With the window's means E[.], mu = E[x], s_x = E[xx] - mu², s_xy = E[xy] - mu mu_y and

    S = A1 A2 / (B1 B2),   A1 = 2 mu mu_y + C1,  A2 = 2 s_xy + C2,  B1 = mu² + mu_y² + C1,  B2 = s_x + s_y + C2

the derivatives of the sum of S by the three means are maps of their own,

    by E[xx]: -S / B2      by E[xy]: 2 A1 / (B1 B2)
    by mu:    2 mu_y (A2 - A1) / (B1 B2) + 2 mu S (1 / B2 - 1 / B1)

and as the window is symmetric, dS/dx is E[by mu] + 2 x E[by E[xx]] + y E[by E[xy]]. In both directions the window is
applied down the columns into rows of scratch, then along these rows. mu_y and s_y depend on the target alone and are
cached (`target_moments_kernel`).

A thread processes a part of the picture from top to bottom, in bands of a few rows. The gradient of a band needs the
maps of that band and of the two beside it, so three bands of maps suffice, which stay in the thread's cache. The bands
where two parts meet are computed for both.
"""
from __future__ import annotations

import weakref
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .. import loss as definition
from . import buffers
from .buffers import Array
from .compilation import inlined, kernel
from .threads import parallel
from .tiles import EMPTY, flat
from .vector import (
    LANES,
    absolute,
    align_lanes,
    atomic_add,
    atomic_increment,
    fma,
    lane_index,
    load,
    load_rows,
    multiply_each,
    prefetch,
    reduce_add,
    splat,
    store,
    where,
)

HALO = definition.WINDOW // 2
PAD = LANES  # zeros on both sides of a scratch row, at least 3 HALO
STEP = 3  # numbers from a pixel to its neighbour in x
BAND = LANES - 2 * HALO
"""Rows of a band: together with those that their windows cover, as many as there are vectors in a tuple of rows."""
WEIGHTS = definition.window(torch.zeros(1)).numpy().astype(np.float32)
W0, W1, W2, W3, W4, W5 = (WEIGHTS[HALO + i] for i in range(HALO + 1))
C1, C2 = np.float32(definition.C1), np.float32(definition.C2)
ZERO, ONE, TWO = np.float32(0), np.float32(1), np.float32(2)


@inlined
def _apply_window(rows):
    """Return the window's weighted sum of 11 vectors, a tuple."""
    total = rows[5] * W0
    total = fma(rows[4] + rows[6], W1, total)
    total = fma(rows[3] + rows[7], W2, total)
    total = fma(rows[2] + rows[8], W3, total)
    total = fma(rows[1] + rows[9], W4, total)
    return fma(rows[0] + rows[10], W5, total)


@inlined
def _window_horizontally(row, column):
    """Return the window's weighted sums along a padded row of scratch, at 16 numbers of the picture's row from `column`
    on.

    Neighbours in x are 3 numbers apart: -15, -12 ... 15. They are shuffled out of three vectors: unaligned loads take
    twice the time, since nearly all of them cross a cache line."""
    column += PAD
    a, b, c = load(row, column - LANES), load(row, column), load(row, column + LANES)
    return _apply_window((
        align_lanes(a, b, 1), align_lanes(a, b, 4), align_lanes(a, b, 7), align_lanes(a, b, 10),
        align_lanes(a, b, 13), b, align_lanes(b, c, 3),
        align_lanes(b, c, 6), align_lanes(b, c, 9), align_lanes(b, c, 12), align_lanes(b, c, 15),
    ))  # fmt: skip


@inlined
def _window_vertically(vectors, rows, column):
    """Apply the window down 16 columns of a band, and write them to rows of scratch from `column` on.

    vectors: the 16 columns in the band's 6 rows and in 5 more rows on each side."""
    store(rows[0], PAD + column, _apply_window(vectors[:11]))
    store(rows[1], PAD + column, _apply_window(vectors[1:12]))
    store(rows[2], PAD + column, _apply_window(vectors[2:13]))
    store(rows[3], PAD + column, _apply_window(vectors[3:14]))
    store(rows[4], PAD + column, _apply_window(vectors[4:15]))
    store(rows[5], PAD + column, _apply_window(vectors[5:]))


@inlined
def _is_interior(first_row, height):
    """Return whether the windows of a band, which starts at first_row, lie within the picture."""
    return HALO <= first_row <= height - BAND - HALO


@inlined
def _column_moments(x, y, row, column, row_length, height):
    """Return E[x], E[xx] and E[xy] down the columns, at 16 numbers of a row from `column` on; row_length: numbers of a
    row."""
    mean, xx, xy = splat(ZERO), splat(ZERO), splat(ZERO)
    for k in range(max(-HALO, -row), min(HALO + 1, height - row)):
        value = load(x, (row + k) * row_length + column)
        weighted = value * WEIGHTS[k + HALO]
        y_value = load(y, (row + k) * row_length + column)
        mean, xx, xy = mean + weighted, fma(weighted, value, xx), fma(weighted, y_value, xy)
    return mean, xx, xy


@inlined
def _write_vertical_moments(x, y, first_row, end_row, row_length, height, rows):
    """Write the column moments of rows first_row .. end_row - 1 of the pictures x and y to `rows` of scratch (3, BAND,
    padded). Within the picture each row is loaded once for all windows. row_length: numbers in a row."""
    for block in range(0, row_length, LANES):
        column = min(block, row_length - LANES)
        if _is_interior(first_row, height):
            top = (first_row - HALO) * row_length + column
            x_rows, y_rows = load_rows(x, top, row_length), load_rows(y, top, row_length)
            _window_vertically(x_rows, rows[0], column)
            _window_vertically(multiply_each(x_rows, x_rows), rows[1], column)
            _window_vertically(multiply_each(x_rows, y_rows), rows[2], column)
        else:
            for row in range(first_row, end_row):
                mean, xx, xy = _column_moments(x, y, row, column, row_length, height)
                store(rows[0, row - first_row], PAD + column, mean)
                store(rows[1, row - first_row], PAD + column, xx)
                store(rows[2, row - first_row], PAD + column, xy)
        for row in range(LANES, LANES + BAND):  # the rows that the next band needs in addition
            prefetch(x, (first_row - HALO + row) * row_length + column)
            prefetch(y, (first_row - HALO + row) * row_length + column)


@inlined
def _window_maps_vertically(maps_above, maps_here, maps_below, row_length, rows):
    """Apply the window down the columns of each of three maps (3, BAND, row_length), for the band of maps_here, and
    write them to `rows` of scratch."""
    for i in range(3):
        above, here, below = maps_above[i], maps_here[i], maps_below[i]
        for block in range(0, row_length, LANES):
            column = min(block, row_length - LANES)
            vectors = (
                load(above[1], column), load(above[2], column), load(above[3], column), load(above[4], column),
                load(above[5], column),
                load(here[0], column), load(here[1], column), load(here[2], column), load(here[3], column),
                load(here[4], column), load(here[5], column),
                load(below[0], column), load(below[1], column), load(below[2], column), load(below[3], column),
                load(below[4], column),
            )  # fmt: skip
            _window_vertically(vectors, rows[i], column)


@inlined
def _ssim_derivatives(mu, xx, xy, mu_y, s_y):
    """Return S and its derivatives by E[x], E[xx], E[xy], from these means and the target's E[y] and s_y."""
    cross, squares = mu * mu_y, fma(mu, mu, mu_y * mu_y)
    a1, a2 = fma(cross, TWO, splat(C1)), fma(xy - cross, TWO, splat(C2))
    b1, b2 = squares + C1, xx - mu * mu + s_y + C2
    inverse_b1_b2 = ONE / (b1 * b2)
    similarity = a1 * a2 * inverse_b1_b2
    s_over_b2 = similarity * (b1 * inverse_b1_b2)  # S / B2
    by_mu = TWO * (mu_y * (a2 - a1) * inverse_b1_b2 + mu * (s_over_b2 - similarity * (b2 * inverse_b1_b2)))
    return similarity, by_mu, -s_over_b2, TWO * a1 * inverse_b1_b2


@inlined
def _compute_maps(x, y, mu_y, s_y, first_row, row_length, height, rows, maps, sums):
    """Write the derivatives of S by mu, E[xx] and E[xy] in a band to maps (3, BAND, row_length), zeros below the
    picture, and the sums of |x - y| and of S along each row to sums (h, 2).

    x, y: image and target, flat; mu_y, s_y: moments of the target; row_length: numbers in a row, 3 w; rows: scratch."""
    end_row = min(first_row + BAND, height)
    _write_vertical_moments(x, y, first_row, end_row, row_length, height, rows)
    if end_row < first_row + BAND:
        maps[:, :, :] = ZERO
    for row in range(first_row, end_row):
        band_row = row - first_row
        l1, ssim = splat(ZERO), splat(ZERO)
        for block in range(0, row_length, LANES):
            column = min(block, row_length - LANES)
            is_new = lane_index() >= np.float32(block - column)  # the last block overlaps the one before
            i = row * row_length + column
            prefetch(mu_y, i + row_length)
            prefetch(s_y, i + row_length)
            mu, xx = _window_horizontally(rows[0, band_row], column), _window_horizontally(rows[1, band_row], column)
            xy = _window_horizontally(rows[2, band_row], column)
            similarity, by_mu, by_xx, by_xy = _ssim_derivatives(mu, xx, xy, load(mu_y, i), load(s_y, i))
            store(maps[0, band_row], column, by_mu)
            store(maps[1, band_row], column, by_xx)
            store(maps[2, band_row], column, by_xy)
            ssim = ssim + where(is_new, similarity, ZERO)
            l1 = l1 + where(is_new, absolute(load(x, i) - load(y, i)), ZERO)
        sums[row, 0], sums[row, 1] = reduce_add(l1), reduce_add(ssim)


@inlined
def _write_gradient(
    x, y, maps_above, maps_here, maps_below, first_row, row_length, height, by_l1, by_similarity, rows, out
):  # fmt: skip
    """Write by_l1 sign(x - y) + by_similarity dS/dx of the band from first_row on to `out`.

    x, y, out: flat; maps_above, maps_here, maps_below: derivatives of S in the band above, in this one and in the one
    below; rows: scratch; row_length: numbers in a row."""
    _window_maps_vertically(maps_above, maps_here, maps_below, row_length, rows)
    for row in range(first_row, min(first_row + BAND, height)):
        band_row = row - first_row
        for block in range(0, row_length, LANES):
            column = min(block, row_length - LANES)
            i = row * row_length + column
            prefetch(out, i + row_length)
            vx, vy = load(x, i), load(y, i)
            by_mu = _window_horizontally(rows[0, band_row], column)
            gradient = fma(vx * TWO, _window_horizontally(rows[1, band_row], column), by_mu)
            gradient = fma(vy, _window_horizontally(rows[2, band_row], column), gradient) * by_similarity
            sign = where(vx > vy, splat(by_l1), where(vx < vy, splat(-by_l1), ZERO))
            store(out, i, gradient + sign)


@kernel
def loss_and_gradient(counter, scratch, x, y, mu_y, s_y, width, height, lam, parts, parts_done, sums, value, out):
    """Write the loss, lam L1 + (1 - lam) (1 - SSIM), to value (1,) and its gradient by x to `out`, unless it is empty.

    The loop writes the maps of one band, then the gradient of the band above it; the module head explains the bands.
    counter: index of the next part. x, y: image and target, flat. mu_y, s_y: window means and variances of the target.
    parts: number of parts of the picture, each the work of a thread. parts_done (1,): number of finished parts, 0 at
    first. scratch, sums (h, 2): workspaces.
    """
    row_length = STEP * width
    maps = scratch[: 9 * BAND * row_length].reshape(3, 3, BAND, row_length)
    rows = scratch[9 * BAND * row_length :][: 3 * BAND * (row_length + 2 * PAD)].reshape(3, BAND, row_length + 2 * PAD)
    rows[:, :, :] = ZERO
    bands, num_values = -(-height // BAND), np.float32(x.size)
    by_l1, by_similarity = lam / num_values, (lam - ONE) / num_values
    while True:
        part = atomic_increment(counter)
        if part >= parts:
            break
        first_band, end_band = bands * part // parts, bands * (part + 1) // parts
        halo_bands = 1 if out.size > 0 else 0  # the gradient needs the maps of the bands beside
        for band in range(first_band - halo_bands, end_band + halo_bands):
            maps_below = maps[(band + 3) % 3]  # a ring of three bands; band may be -1
            if 0 <= band < bands:
                _compute_maps(x, y, mu_y, s_y, band * BAND, row_length, height, rows, maps_below, sums)
            else:
                maps_below[:, :, :] = ZERO
            if halo_bands > 0 and band > first_band:
                maps_above, maps_here = maps[(band + 1) % 3], maps[(band + 2) % 3]
                _write_gradient(
                    x, y, maps_above, maps_here, maps_below, (band - 1) * BAND, row_length, height, by_l1,
                    by_similarity, rows, out
                )
        if atomic_add(parts_done, 0, 1) == parts - 1:  # the last to finish adds up the rows, always in the same order
            l1, similarity = 0.0, 0.0
            for row in range(height):
                l1 += sums[row, 0]
                similarity += sums[row, 1]
            value[0] = lam * l1 / num_values + (1 - lam) * (1 - similarity / num_values)


@kernel
def target_moments_kernel(counter, scratch, y, width, height, mu_y, s_y):
    """Write the window means mu_y and variances s_y of the target y, all flat. counter: index of the next row."""
    row_length = STEP * width
    rows = scratch[: 2 * (row_length + 2 * PAD)].reshape(2, row_length + 2 * PAD)
    rows[:, :] = ZERO
    while True:
        row = atomic_increment(counter)
        if row >= height:
            break
        for block in range(0, row_length, LANES):
            column = min(block, row_length - LANES)
            mean, yy, _ = _column_moments(y, y, row, column, row_length, height)
            store(rows[0], PAD + column, mean)
            store(rows[1], PAD + column, yy)
        for block in range(0, row_length, LANES):
            column = min(block, row_length - LANES)
            mu = _window_horizontally(rows[0], column)
            store(mu_y, row * row_length + column, mu)
            store(s_y, row * row_length + column, _window_horizontally(rows[1], column) - mu * mu)


def _scratch_size(width: int) -> int:
    return 3 * BAND * (STEP * width + 2 * PAD) + 9 * BAND * STEP * width


class _CacheEntry(NamedTuple):
    target: weakref.ref[Tensor]
    version: int
    moments: Array


class _TargetMoments:
    """A cache of the window means and variances of recent targets, of bounded size."""

    MAX_BYTES = 256 << 20

    def __init__(self) -> None:
        # By id of the tensor; the latest used is last.
        self._entries: dict[int, _CacheEntry] = {}

    def __call__(self, target: Tensor) -> Array:
        """Return mu_y and s_y (2, values) of a target, from the cache while the tensor is unchanged."""
        key = id(target)
        entry = self._entries.pop(key, None)
        if entry is not None and entry.target() is target and entry.version == target._version:
            self._entries[key] = entry  # the latest is last
            return entry.moments
        height, width, _ = target.shape
        moments = np.empty((2, target.numel()), np.float32)
        parallel(target_moments_kernel, flat(target), width, height, *moments, scratch=_scratch_size(width))
        reference = weakref.ref(target, lambda _: self._entries.pop(key, None))
        self._entries[key] = _CacheEntry(reference, target._version, moments)
        free_bytes = self.MAX_BYTES
        for target_id, entry in reversed(list(self._entries.items())):
            free_bytes -= entry.moments.nbytes
            if free_bytes < 0 and target_id != key:
                self._entries.pop(target_id, None)
        return moments


_target_moments = _TargetMoments()


class _L1Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, lam: float) -> Tensor:  # type: ignore[override]
        """Return the loss, a scalar; its gradient by the image is computed at once and kept for `backward`.

        image, target: (height, width, 3). lam: weight of L1, 0..1; SSIM has the others.
        """
        height, width, _ = image.shape
        mu_y, s_y = _target_moments(target)
        value, gradient = np.empty(1, np.float32), EMPTY
        if ctx.needs_input_grad[0]:
            ctx.gradient, gradient = buffers.tensor_and_array(height, width, 3)
        parallel(
            loss_and_gradient, flat(image), flat(target), mu_y, s_y, width, height, np.float32(lam),
            torch.get_num_threads(), np.zeros(1, np.int64), np.empty((height, 2)), value, gradient,
            scratch=_scratch_size(width),
        )  # fmt: skip
        return torch.from_numpy(value.reshape(()))

    @staticmethod
    def backward(ctx: Any, d_loss: Tensor) -> Any:  # type: ignore[override]
        return ctx.gradient if d_loss.item() == 1 else ctx.gradient * d_loss, None, None


def l1_ssim(image: Tensor, target: Tensor, lam: float) -> Tensor:
    """Return the loss of `l1_ssim` of `..loss`; a picture whose rows are shorter than a vector is left to torch."""
    if STEP * image.shape[1] < LANES:
        return definition.l1_ssim(image, target, lam, kernels="torch")
    return _L1Ssim.apply(image, target.detach() if target.requires_grad else target, lam)
