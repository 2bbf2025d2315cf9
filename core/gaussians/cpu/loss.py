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
BAND, STRIP = 8, 8 * LANES
"""Rows to a piece of work, and numbers of a row that are blurred down the columns at a time."""
WEIGHTS = definition.window(torch.zeros(1)).numpy().astype(np.float32)
W0, W1, W2, W3, W4, W5 = (WEIGHTS[HALO + i] for i in range(HALO + 1))
C1, C2 = np.float32(definition.C1), np.float32(definition.C2)
ZERO, ONE, TWO = np.float32(0), np.float32(1), np.float32(2)


@inlined
def _window(a, at, step):
    """The window over values that lie `step` apart."""
    s = load(a, at) * W0
    s = fma(load(a, at - step) + load(a, at + step), W1, s)
    s = fma(load(a, at - 2 * step) + load(a, at + 2 * step), W2, s)
    s = fma(load(a, at - 3 * step) + load(a, at + 3 * step), W3, s)
    s = fma(load(a, at - 4 * step) + load(a, at + 4 * step), W4, s)
    return fma(load(a, at - 5 * step) + load(a, at + 5 * step), W5, s)


@inlined
def _down(plane, row, at, length, height):
    """The window down the columns, 16 of them, with zeros above and below the picture."""
    i = row * length + at
    if HALO <= row < height - HALO:
        return _window(plane, i, length)
    s = splat(ZERO)
    for k in range(max(-HALO, -row), min(HALO + 1, height - row)):
        s = fma(load(plane, i + k * length), WEIGHTS[k + HALO], s)
    return s


@inlined
def _tap(x, y, i, weight, sums):
    a = load(x, i)
    w = a * weight
    return sums[0] + w, fma(w, a, sums[1]), fma(w, load(y, i), sums[2])


@inlined
def _down_moments(x, y, row, at, length, height):
    """E[x], E[xx] and E[xy] down the columns."""
    i, zero = row * length + at, splat(ZERO)
    sums = (zero, zero, zero)
    if HALO <= row < height - HALO:
        sums = _tap(x, y, i - 5 * length, W5, _tap(x, y, i + 5 * length, W5, sums))
        sums = _tap(x, y, i - 4 * length, W4, _tap(x, y, i + 4 * length, W4, sums))
        sums = _tap(x, y, i - 3 * length, W3, _tap(x, y, i + 3 * length, W3, sums))
        sums = _tap(x, y, i - 2 * length, W2, _tap(x, y, i + 2 * length, W2, sums))
        sums = _tap(x, y, i - length, W1, _tap(x, y, i + length, W1, sums))
        return _tap(x, y, i, W0, sums)
    for k in range(max(-HALO, -row), min(HALO + 1, height - row)):
        sums = _tap(x, y, i + k * length, WEIGHTS[k + HALO], sums)
    return sums


@inlined
def _columns_of_moments(x, y, band, end, length, height, rows):
    """The same for the rows of a band, into scratch; by strips of columns, so that the nearest cache holds the rows."""
    for strip in range(0, length, STRIP):
        for row in range(band, end):
            for block in range(strip, min(strip + STRIP, length), LANES):
                at = min(block, length - LANES)
                m, xx, xy = _down_moments(x, y, row, at, length, height)
                place = row - band
                store(rows[0, place], PAD + at, m)
                store(rows[1, place], PAD + at, xx)
                store(rows[2, place], PAD + at, xy)


@inlined
def _columns_of_maps(maps, band, end, length, height, rows):
    for strip in range(0, length, STRIP):
        for row in range(band, end):
            for block in range(strip, min(strip + STRIP, length), LANES):
                at = min(block, length - LANES)
                place = row - band
                store(rows[0, place], PAD + at, _down(maps[0], row, at, length, height))
                store(rows[1, place], PAD + at, _down(maps[1], row, at, length, height))
                store(rows[2, place], PAD + at, _down(maps[2], row, at, length, height))


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
    rows = scratch[: 3 * BAND * (length + 2 * PAD)].reshape(3, BAND, length + 2 * PAD)
    rows[:, :, :] = ZERO
    while True:
        band = take_number(counter) * BAND
        end = min(band + BAND, height)
        if band >= height:
            break
        _columns_of_moments(x, y, band, end, length, height, rows)
        for row in range(band, end):
            place = row - band
            l1, similar = splat(ZERO), splat(ZERO)
            for block in range(0, length, LANES):
                at = min(block, length - LANES)
                fresh = lanes() >= np.float32(block - at)  # the last block overlaps the one before
                i = row * length + at
                mu, xx = _window(rows[0, place], PAD + at, STEP), _window(rows[1, place], PAD + at, STEP)
                xy = _window(rows[2, place], PAD + at, STEP)
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
    rows = scratch[: 3 * BAND * (length + 2 * PAD)].reshape(3, BAND, length + 2 * PAD)
    rows[:, :, :] = ZERO
    while True:
        band = take_number(counter) * BAND
        end = min(band + BAND, height)
        if band >= height:
            break
        _columns_of_maps(maps, band, end, length, height, rows)
        for row in range(band, end):
            place = row - band
            for block in range(0, length, LANES):
                at = min(block, length - LANES)
                i = row * length + at
                vx, vy = load(x, i), load(y, i)
                g = fma(vx * TWO, _window(rows[1, place], PAD + at, STEP), _window(rows[0, place], PAD + at, STEP))
                g = fma(vy, _window(rows[2, place], PAD + at, STEP), g) * by_similarity
                sign = where(vx > vy, splat(by_l1), where(vx < vy, splat(-by_l1), ZERO))
                store(out, i, g + sign)


@kernel
def describe(counter, scratch, y, width, height, mu_y, s_y):
    """The target's part: means and variances."""
    length = STEP * width
    rows = scratch[: 3 * BAND * (length + 2 * PAD)].reshape(3, BAND, length + 2 * PAD)
    rows[:, :, :] = ZERO
    while True:
        band = take_number(counter) * BAND
        end = min(band + BAND, height)
        if band >= height:
            break
        _columns_of_moments(y, y, band, end, length, height, rows)
        for row in range(band, end):
            place = row - band
            for block in range(0, length, LANES):
                at = min(block, length - LANES)
                mu = _window(rows[0, place], PAD + at, STEP)
                store(mu_y, row * length + at, mu)
                store(s_y, row * length + at, _window(rows[1, place], PAD + at, STEP) - mu * mu)


def _scratch_size(width: int) -> int:
    return 3 * BAND * (STEP * width + 2 * PAD)


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
        l1, similarity = (sums.sum(0) / x.size).tolist()
        if ctx.needs_input_grad[0]:
            d_image, d_image_flat = buffers.pair(height, width, 3)
            scales = np.float32(lam / x.size), np.float32((lam - 1) / x.size)
            parallel(gradient, x, y, maps, width, height, *scales, d_image_flat, scratch=_scratch_size(width))
            ctx.save_for_backward(d_image)
        return image.new_tensor(lam * l1 + (1 - lam) * (1 - similarity))

    @staticmethod
    def backward(ctx: Any, d_loss: Tensor) -> Any:  # type: ignore[override]
        (d_image,) = ctx.saved_tensors
        return d_image if d_loss.item() == 1 else d_image * d_loss, None, None


def l1_ssim(image: Tensor, target: Tensor, lam: float) -> Tensor:
    """See `..loss`."""
    if STEP * image.shape[1] < LANES:
        return definition.l1_ssim(image, target, lam, kernels="torch")
    return _L1Ssim.apply(image, target.detach() if target.requires_grad else target, lam)
