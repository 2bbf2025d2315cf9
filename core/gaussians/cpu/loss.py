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
from typing import Any

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
def _apply_window(v):
    """Return the window's weighted sum of 11 vectors."""
    s = v[5] * W0
    s = fma(v[4] + v[6], W1, s)
    s = fma(v[3] + v[7], W2, s)
    s = fma(v[2] + v[8], W3, s)
    s = fma(v[1] + v[9], W4, s)
    return fma(v[0] + v[10], W5, s)


@inlined
def _window_along_row(row, at):
    """Return the window's weighted sums along a row of scratch, for 16 numbers from `at` on, without the padding.

    Neighbours in x are 3 numbers apart: -15, -12 ... 15. They are shuffled out of three vectors: unaligned loads take
    twice the time, since nearly all of them cross a cache line."""
    at += PAD
    a, b, c = load(row, at - LANES), load(row, at), load(row, at + LANES)
    return _apply_window((
        align_lanes(a, b, 1), align_lanes(a, b, 4), align_lanes(a, b, 7), align_lanes(a, b, 10),
        align_lanes(a, b, 13), b, align_lanes(b, c, 3),
        align_lanes(b, c, 6), align_lanes(b, c, 9), align_lanes(b, c, 12), align_lanes(b, c, 15),
    ))  # fmt: skip


@inlined
def _store_band(v, rows, at):
    """Apply the window down 16 columns of a band and write them to scratch from `at` on.

    v: the band's 6 rows and 5 more on both sides."""
    store(rows[0], PAD + at, _apply_window(v[:11]))
    store(rows[1], PAD + at, _apply_window(v[1:12]))
    store(rows[2], PAD + at, _apply_window(v[2:13]))
    store(rows[3], PAD + at, _apply_window(v[3:14]))
    store(rows[4], PAD + at, _apply_window(v[4:15]))
    store(rows[5], PAD + at, _apply_window(v[5:]))


@inlined
def _is_interior(band, height):
    """Return whether the windows of a band lie within the picture; band: its first row."""
    return HALO <= band <= height - BAND - HALO


@inlined
def _column_moments(x, y, row, at, length, height):
    """Return E[x], E[xx] and E[xy] down the columns, at 16 numbers of a row from `at` on; length: numbers of a row."""
    m, xx, xy = splat(ZERO), splat(ZERO), splat(ZERO)
    for k in range(max(-HALO, -row), min(HALO + 1, height - row)):
        a = load(x, (row + k) * length + at)
        w = a * WEIGHTS[k + HALO]
        m, xx, xy = m + w, fma(w, a, xx), fma(w, load(y, (row + k) * length + at), xy)
    return m, xx, xy


@inlined
def _columns_of_moments(x, y, band, end, length, height, rows):
    """Write the column moments of rows band .. end of the picture to scratch; loads the rows of all windows once."""
    for block in range(0, length, LANES):
        at = min(block, length - LANES)
        if _is_interior(band, height):
            top = (band - HALO) * length + at
            a, b = load_rows(x, top, length), load_rows(y, top, length)
            _store_band(a, rows[0], at)
            _store_band(multiply_each(a, a), rows[1], at)
            _store_band(multiply_each(a, b), rows[2], at)
        else:
            for row in range(band, end):
                m, xx, xy = _column_moments(x, y, row, at, length, height)
                store(rows[0, row - band], PAD + at, m)
                store(rows[1, row - band], PAD + at, xx)
                store(rows[2, row - band], PAD + at, xy)
        for row in range(LANES, LANES + BAND):  # the rows that the next band needs in addition
            prefetch(x, (band - HALO + row) * length + at)
            prefetch(y, (band - HALO + row) * length + at)


@inlined
def _columns_of_maps(before, here, after, length, rows):
    """Apply the window down the columns of each of three maps (3, BAND, length), for the band `here`, with the maps of
    the bands before and after it."""
    for i in range(3):
        a, b, c = before[i], here[i], after[i]
        for block in range(0, length, LANES):
            at = min(block, length - LANES)
            v = (
                load(a[1], at), load(a[2], at), load(a[3], at), load(a[4], at), load(a[5], at),
                load(b[0], at), load(b[1], at), load(b[2], at), load(b[3], at), load(b[4], at), load(b[5], at),
                load(c[0], at), load(c[1], at), load(c[2], at), load(c[3], at), load(c[4], at),
            )  # fmt: skip
            _store_band(v, rows[i], at)


@inlined
def _ssim_derivatives(mu, xx, xy, mu_y, s_y):
    """Return S and its derivatives by E[x], E[xx], E[xy], from these means and the target's E[y] and s_y."""
    cross, squares = mu * mu_y, fma(mu, mu, mu_y * mu_y)
    a1, a2 = fma(cross, TWO, splat(C1)), fma(xy - cross, TWO, splat(C2))
    b1, b2 = squares + C1, xx - mu * mu + s_y + C2
    inverse = ONE / (b1 * b2)
    similarity = a1 * a2 * inverse
    share = similarity * (b1 * inverse)  # S / B2
    by_mu = TWO * (mu_y * (a2 - a1) * inverse + mu * (share - similarity * (b2 * inverse)))
    return similarity, by_mu, -share, TWO * a1 * inverse


@inlined
def _compute_maps(x, y, mu_y, s_y, band, length, height, rows, maps, sums):
    """Write the maps of S by mu, E[xx], E[xy] of a band, (3, BAND, length), zeros below the picture, and the row sums
    (h, 2) of |x - y| and S. band: its first row. length: numbers in a row, 3 w. rows: scratch."""
    end = min(band + BAND, height)
    _columns_of_moments(x, y, band, end, length, height, rows)
    if end < band + BAND:
        maps[:, :, :] = ZERO
    for row in range(band, end):
        place = row - band
        l1, similar = splat(ZERO), splat(ZERO)
        for block in range(0, length, LANES):
            at = min(block, length - LANES)
            is_new = lane_index() >= np.float32(block - at)  # the last block overlaps the one before
            i = row * length + at
            prefetch(mu_y, i + length)
            prefetch(s_y, i + length)
            mu, xx = _window_along_row(rows[0, place], at), _window_along_row(rows[1, place], at)
            xy = _window_along_row(rows[2, place], at)
            s, by_mu, by_xx, by_xy = _ssim_derivatives(mu, xx, xy, load(mu_y, i), load(s_y, i))
            store(maps[0, place], at, by_mu)
            store(maps[1, place], at, by_xx)
            store(maps[2, place], at, by_xy)
            similar = similar + where(is_new, s, ZERO)
            l1 = l1 + where(is_new, absolute(load(x, i) - load(y, i)), ZERO)
        sums[row, 0], sums[row, 1] = reduce_add(l1), reduce_add(similar)


@inlined
def _gradient(x, y, before, here, after, band, length, height, by_l1, by_similarity, rows, out):
    """Write by_l1 sign(x - y) + by_similarity dS/dx of a band, from its maps `here` and those of its neighbours."""
    _columns_of_maps(before, here, after, length, rows)
    for row in range(band, min(band + BAND, height)):
        place = row - band
        for block in range(0, length, LANES):
            at = min(block, length - LANES)
            i = row * length + at
            prefetch(out, i + length)
            vx, vy = load(x, i), load(y, i)
            g = fma(vx * TWO, _window_along_row(rows[1, place], at), _window_along_row(rows[0, place], at))
            g = fma(vy, _window_along_row(rows[2, place], at), g) * by_similarity
            sign = where(vx > vy, splat(by_l1), where(vx < vy, splat(-by_l1), ZERO))
            store(out, i, g + sign)


@kernel
def loss_and_gradient(counter, scratch, x, y, mu_y, s_y, width, height, lam, parts, done, sums, value, out):
    """Write the loss to value (1,) and its gradient by x to `out`, unless `out` is empty.

    lam: weight of L1; parts: number of parts of the picture, each the work of a thread; done (1,): 0, counts finished
    parts; sums (h, 2): workspace."""
    length = STEP * width
    maps = scratch[: 9 * BAND * length].reshape(3, 3, BAND, length)
    rows = scratch[9 * BAND * length :][: 3 * BAND * (length + 2 * PAD)].reshape(3, BAND, length + 2 * PAD)
    rows[:, :, :] = ZERO
    bands, size = -(-height // BAND), np.float32(x.size)
    by_l1, by_similarity = lam / size, (lam - ONE) / size
    while True:
        part = atomic_increment(counter)
        if part >= parts:
            break
        first, end = bands * part // parts, bands * (part + 1) // parts
        halo_bands = 1 if out.size > 0 else 0  # the gradient needs the maps of the bands beside
        for number in range(first - halo_bands, end + halo_bands):
            here = maps[(number + 3) % 3]  # a ring of three bands; number may be -1
            if 0 <= number < bands:
                _compute_maps(x, y, mu_y, s_y, number * BAND, length, height, rows, here, sums)
            else:
                here[:, :, :] = ZERO
            if halo_bands > 0 and number > first:
                before, middle = maps[(number + 1) % 3], maps[(number + 2) % 3]
                _gradient(
                    x, y, before, middle, here, (number - 1) * BAND, length, height, by_l1, by_similarity, rows, out
                )
        if atomic_add(done, 0, 1) == parts - 1:  # whoever finishes last adds up the rows, always in the same order
            l1, similarity = 0.0, 0.0
            for row in range(height):
                l1 += sums[row, 0]
                similarity += sums[row, 1]
            value[0] = lam * l1 / size + (1 - lam) * (1 - similarity / size)


@kernel
def target_moments_kernel(counter, scratch, y, width, height, mu_y, s_y):
    """Write the window means mu_y and variances s_y of the target y, all flat."""
    length = STEP * width
    rows = scratch[: 2 * (length + 2 * PAD)].reshape(2, length + 2 * PAD)
    rows[:, :] = ZERO
    while True:
        row = atomic_increment(counter)
        if row >= height:
            break
        for block in range(0, length, LANES):
            at = min(block, length - LANES)
            m, yy, _ = _column_moments(y, y, row, at, length, height)
            store(rows[0], PAD + at, m)
            store(rows[1], PAD + at, yy)
        for block in range(0, length, LANES):
            at = min(block, length - LANES)
            mu = _window_along_row(rows[0], at)
            store(mu_y, row * length + at, mu)
            store(s_y, row * length + at, _window_along_row(rows[1], at) - mu * mu)


def _scratch_size(width: int) -> int:
    return 3 * BAND * (STEP * width + 2 * PAD) + 9 * BAND * STEP * width


class _TargetMoments:
    """A cache of the window means and variances of recent targets, of bounded size."""

    MAX_BYTES = 256 << 20

    def __init__(self) -> None:
        # By id of the tensor: a reference to it, its version, and the moments; the latest used is last.
        self._entries: dict[int, tuple[weakref.ref[Tensor], int, Array]] = {}

    def __call__(self, target: Tensor) -> Array:
        """Return mu_y and s_y (2, values) of a target, from the cache while the tensor is unchanged."""
        key = id(target)
        entry = self._entries.pop(key, None)
        if entry is not None and entry[0]() is target and entry[1] == target._version:
            self._entries[key] = entry  # the latest is last
            return entry[2]
        height, width, _ = target.shape
        moments = np.empty((2, target.numel()), np.float32)
        parallel(target_moments_kernel, flat(target), width, height, *moments, scratch=_scratch_size(width))
        self._entries[key] = weakref.ref(target, lambda _: self._entries.pop(key, None)), target._version, moments
        free_bytes = self.MAX_BYTES
        for name, (_, _, array) in reversed(list(self._entries.items())):
            free_bytes -= array.nbytes
            if free_bytes < 0 and name != key:
                self._entries.pop(name, None)
        return moments


_target_moments = _TargetMoments()


class _L1Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, lam: float) -> Tensor:  # type: ignore[override]
        """Return the loss, a scalar; its gradient by the image is computed at once and kept for `backward`."""
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
