# SPDX-License-Identifier: GPL-3.0-or-later
"""L1 and SSIM with their gradient in one go (the definition is `..loss`).

A picture row is 3 w numbers, red, green, blue by turns, and neighbours in x are 3 apart: no need to take the colours
apart. With the window's means E[.], mu = E[x], s_x = E[xx] - mu², s_xy = E[xy] - mu mu_y and

    S = A1 A2 / (B1 B2),   A1 = 2 mu mu_y + C1,  A2 = 2 s_xy + C2,  B1 = mu² + mu_y² + C1,  B2 = s_x + s_y + C2

the derivatives of the sum of S by the three means are maps of their own,

    by E[xx]: -S / B2      by E[xy]: 2 A1 / (B1 B2)
    by mu:    2 mu_y (A2 - A1) / (B1 B2) + 2 mu S (1 / B2 - 1 / B1)

and as the window is symmetric, dS/dx is E[by mu] + 2 x E[by E[xx]] + y E[by E[xy]]. So: `compare` goes from
pictures to maps, `gradient` from maps to the gradient; each blurs three planes, down the columns into rows of
scratch, then along these. mu_y and s_y depend on the target alone and are kept (`describe`).
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
from .tiles import flat
from .vector import LANES, absolute, fma, lanes, load, splat, store, take_number, total, where

HALO = definition.WINDOW // 2
PAD = 16  # at least 3 HALO zeros on both sides of a scratch row
STEP = 3
BAND = 4
"""Rows to a piece of work."""
WEIGHTS = definition.window(torch.zeros(1)).numpy().astype(np.float32)
W0, W1, W2, W3, W4, W5 = (WEIGHTS[HALO + i] for i in range(HALO + 1))
C1, C2 = np.float32(definition.C1), np.float32(definition.C2)
ZERO, ONE, TWO = np.float32(0), np.float32(1), np.float32(2)


@inlined
def _along(row, at):
    """The window along a scratch row."""
    s = load(row, at) * W0
    s = fma(load(row, at - STEP) + load(row, at + STEP), W1, s)
    s = fma(load(row, at - 2 * STEP) + load(row, at + 2 * STEP), W2, s)
    s = fma(load(row, at - 3 * STEP) + load(row, at + 3 * STEP), W3, s)
    s = fma(load(row, at - 4 * STEP) + load(row, at + 4 * STEP), W4, s)
    return fma(load(row, at - 5 * STEP) + load(row, at + 5 * STEP), W5, s)


@inlined
def _rows_around(y, height):
    """The rows under the window of row y: first and end."""
    return max(y - HALO, 0), min(y + HALO + 1, height)


@inlined
def _down_moments(x, y, row, at, length, height, rows, out):
    """E[x], E[xx] and E[xy] down the columns, 16 of them, into the three scratch rows."""
    first, end = _rows_around(row, height)
    m, xx, xy = splat(ZERO), splat(ZERO), splat(ZERO)
    for r in range(first, end):
        a = load(x, r * length + at)
        w = a * WEIGHTS[r - row + HALO]
        m = m + w
        xx = fma(w, a, xx)
        xy = fma(w, load(y, r * length + at), xy)
    store(rows[0], out, m)
    store(rows[1], out, xx)
    store(rows[2], out, xy)


@inlined
def _similarity(mu, xx, xy, mu_y, s_y):
    """S and its derivatives by E[x], E[xx], E[xy]."""
    cross, squares = mu * mu_y, fma(mu, mu, mu_y * mu_y)
    a1, a2 = fma(cross, TWO, splat(C1)), fma(xy - cross, TWO, splat(C2))
    b1, b2 = squares + C1, xx - mu * mu + s_y + C2
    inverse = ONE / (b1 * b2)
    similarity = a1 * a2 * inverse
    share = similarity * (b1 * inverse)  # S / B2
    by_mu = TWO * (mu_y * (a2 - a1) * inverse + mu * (share - similarity * (b2 * inverse)))
    return similarity, by_mu, -share, TWO * a1 * inverse


@kernel
def compare(counter, scratch, x, y, mu_y, s_y, width, height, maps, sums):
    """maps (3, h, 3w): derivatives of S by the means; sums (h, 2): of |x - y| and of S, by row."""
    length = STEP * width
    rows = scratch[: 3 * (length + 2 * PAD)].reshape(3, length + 2 * PAD)
    rows[:, :] = ZERO
    while True:
        band = take_number(counter) * BAND
        if band >= height:
            break
        for row in range(band, min(band + BAND, height)):
            for block in range(0, length, LANES):
                at = min(block, length - LANES)
                _down_moments(x, y, row, at, length, height, rows, PAD + at)
            l1, similar = splat(ZERO), splat(ZERO)
            for block in range(0, length, LANES):
                at = min(block, length - LANES)
                fresh = lanes() >= np.float32(block - at)  # the last block overlaps the one before
                i = row * length + at
                mu, xx, xy = _along(rows[0], PAD + at), _along(rows[1], PAD + at), _along(rows[2], PAD + at)
                s, by_mu, by_xx, by_xy = _similarity(mu, xx, xy, load(mu_y, i), load(s_y, i))
                store(maps[0], i, by_mu)
                store(maps[1], i, by_xx)
                store(maps[2], i, by_xy)
                similar = similar + where(fresh, s, ZERO)
                l1 = l1 + where(fresh, absolute(load(x, i) - load(y, i)), ZERO)
            sums[row, 0], sums[row, 1] = total(l1), total(similar)


@kernel
def gradient(counter, scratch, x, y, maps, width, height, by_l1, by_similarity, out):
    """out = by_l1 sign(x - y) + by_similarity dS/dx."""
    length = STEP * width
    rows = scratch[: 3 * (length + 2 * PAD)].reshape(3, length + 2 * PAD)
    rows[:, :] = ZERO
    while True:
        band = take_number(counter) * BAND
        if band >= height:
            break
        for row in range(band, min(band + BAND, height)):
            first, end = _rows_around(row, height)
            for block in range(0, length, LANES):
                at = min(block, length - LANES)
                a, b, c = splat(ZERO), splat(ZERO), splat(ZERO)
                for r in range(first, end):
                    weight = WEIGHTS[r - row + HALO]
                    a = fma(load(maps[0], r * length + at), weight, a)
                    b = fma(load(maps[1], r * length + at), weight, b)
                    c = fma(load(maps[2], r * length + at), weight, c)
                store(rows[0], PAD + at, a)
                store(rows[1], PAD + at, b)
                store(rows[2], PAD + at, c)
            for block in range(0, length, LANES):
                at = min(block, length - LANES)
                i = row * length + at
                vx, vy = load(x, i), load(y, i)
                g = fma(vx * TWO, _along(rows[1], PAD + at), _along(rows[0], PAD + at))
                g = fma(vy, _along(rows[2], PAD + at), g) * by_similarity
                sign = where(vx > vy, splat(by_l1), where(vx < vy, splat(-by_l1), ZERO))
                store(out, i, g + sign)


@kernel
def describe(counter, scratch, y, width, height, mu_y, s_y):
    """The target's part: means and variances."""
    length = STEP * width
    rows = scratch[: 3 * (length + 2 * PAD)].reshape(3, length + 2 * PAD)
    rows[:, :] = ZERO
    while True:
        band = take_number(counter) * BAND
        if band >= height:
            break
        for row in range(band, min(band + BAND, height)):
            for block in range(0, length, LANES):
                at = min(block, length - LANES)
                _down_moments(y, y, row, at, length, height, rows, PAD + at)
            for block in range(0, length, LANES):
                at = min(block, length - LANES)
                mu = _along(rows[0], PAD + at)
                store(mu_y, row * length + at, mu)
                store(s_y, row * length + at, _along(rows[1], PAD + at) - mu * mu)


def _scratch_size(width: int) -> int:
    return 3 * (STEP * width + 2 * PAD)


class _Described:
    """What `describe` says of the targets met last, within a bound on memory."""

    LIMIT = 256 << 20

    def __init__(self) -> None:
        self._known: dict[int, tuple[weakref.ref[Tensor], int, Array]] = {}

    def __call__(self, target: Tensor) -> Array:
        key = id(target)
        known = self._known.pop(key, None)
        if known is None or known[0]() is not target or known[1] != target._version:
            height, width, _ = target.shape
            described = np.empty((2, target.numel()), np.float32)
            parallel(describe, flat(target), width, height, *described, scratch=_scratch_size(width))
            known = (weakref.ref(target, lambda _: self._known.pop(key, None)), target._version, described)
        self._known[key] = known  # the latest is last
        room = self.LIMIT
        for name, (_, _, array) in reversed(list(self._known.items())):
            room -= array.nbytes
            if room < 0 and name != key:
                self._known.pop(name, None)
        return known[2]


_described = _Described()


class _L1Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, lam: float) -> Tensor:  # type: ignore[override]
        height, width, _ = image.shape
        mu_y, s_y = _described(target)
        x, y = flat(image), flat(target)
        maps, sums = buffers.empty(3 * x.size).reshape(3, x.size), np.empty((height, 2))
        parallel(compare, x, y, mu_y, s_y, width, height, maps, sums, scratch=_scratch_size(width))
        l1, similarity = sums.sum(0) / x.size
        if ctx.needs_input_grad[0]:
            d_image, d_image_flat = buffers.pair(height, width, 3)
            scales = np.float32(lam / x.size), np.float32((lam - 1) / x.size)
            parallel(gradient, x, y, maps, width, height, *scales, d_image_flat, scratch=_scratch_size(width))
            ctx.save_for_backward(d_image)
        return image.new_tensor(lam * l1 + (1 - lam) * (1 - similarity))

    @staticmethod
    def backward(ctx: Any, d_loss: Tensor) -> Any:  # type: ignore[override]
        (d_image,) = ctx.saved_tensors
        return d_image if d_loss == 1 else d_image * d_loss, None, None


def l1_ssim(image: Tensor, target: Tensor, lam: float) -> Tensor:
    """See `..loss`."""
    if STEP * image.shape[1] < LANES:
        return definition.l1_ssim(image, target, lam, kernels="torch")
    return _L1Ssim.apply(image, target.detach() if target.requires_grad else target, lam)
