# SPDX-License-Identifier: GPL-3.0-or-later
"""Tiles drawn in torch, with analytic gradients: for machines without a faster kernel set.

Tiles whose lists are about as long are worked on together, a chunk of their lists at a time, as tensors of
tiles x pixels x entries; (u, v) of `tiled.py` are matrix products of the pixels with the Gaussians.
"""
from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import threshold

from ..choices import Blend
from . import tiled
from .reference import RADIUS_MIN
from .rendering import ALPHA_MIN, OPACITY_MAX, PROFILE_MIN, TRANSMITTANCE_MIN
from .tiled import Gaussians, Lists

TILE = 8
CHUNK = 128
"""Entries of a list at a time."""
GROUP = 32
"""Tiles at a time; with the above, what bounds the memory: half a dozen tensors of 1 MiB."""
AFTER_MIN = TRANSMITTANCE_MIN * (1 - OPACITY_MAX) / 2
"""Below the transmittance behind anything that counts."""


def _pixels(like: Tensor) -> Tensor:
    """(TILE², 3) pixel centres of a tile from its middle, and ones: x, y, 1."""
    along = torch.arange(TILE, dtype=like.dtype, device=like.device) + 0.5 - TILE / 2
    grid = torch.cartesian_prod(along, along).flip(-1)
    return torch.cat([grid, torch.ones_like(grid[:, :1])], -1)


def _groups(lists: Lists, filler: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Tiles that are worked on together: (b,) tile numbers and their (b, longest) entries, `filler` where a
    list is shorter."""
    lengths = lists.starts.diff()
    order = torch.argsort(lengths, descending=True, stable=True)
    busy = int((lengths > 0).sum())
    for first in range(0, busy, GROUP):
        tiles = order[first : min(first + GROUP, busy)]
        place = torch.arange(int(lengths[tiles[0]]), device=tiles.device)
        inside = place < lengths[tiles, None]
        entries = lists.entries[(lists.starts[tiles, None] + place) * inside]
        yield tiles, torch.where(inside, entries, filler)


class _Chunk:
    """Some entries of some tiles, evaluated: tensors are (b, pixels, k) unless said otherwise."""

    def __init__(self, drawn: Gaussians, index: Tensor, origins: Tensor, pixels: Tensor) -> None:
        """index (b, k) rows of `drawn`; origins (b, 2) middles of the tiles, px; pixels as `_pixels`."""
        self.drawn, self.pixels = drawn, pixels
        places = drawn.places[index]
        places[..., :2] -= origins[:, None]
        # (b, k), from the middle of the tile
        self.cx, self.cy, self.w_xx, self.w_yx, self.w_yy = places.to(pixels.dtype).unbind(-1)
        values = drawn.values[index]
        self.peaks, self.values = values[:, None, :, 0], values[..., 1:]  # (b, 1, k), (b, k, c)
        self.u = self._linear(self.w_xx, torch.zeros_like(self.w_xx))
        self.v = self._linear(self.w_yx, self.w_yy)
        q = (self.u * self.u).addcmul_(self.v, self.v)
        if drawn.rings is None:
            log_g = q.mul_(-0.5)
        else:
            r0, self.w = drawn.rings[index][:, None].unbind(-1)
            self.r = q.clamp_(min=RADIUS_MIN**2).sqrt_()
            self.t = (self.r - r0) / self.w
            log_g = self.t.square() * -0.5
        if drawn.arcs is not None:
            self.a_u, self.a_v, m = drawn.arcs[index][:, None].unbind(-1)
            log_g = log_g + (self.a_u * self.u + self.a_v * self.v - m)
        self.g = log_g.exp_()

    def _linear(self, along_x: Tensor, along_y: Tensor) -> Tensor:
        """a (x - cx) + b (y - cy) at all pixels, from (b, k) a and b."""
        offset = -(along_x * self.cx + along_y * self.cy)
        return self.pixels @ torch.stack([along_x, along_y, offset], 1)

    def backward(self, h: Tensor) -> list[Tensor]:
        """From h = dL/dlog g, the gradients (b, k): five of the places, then those of the ring and the arc."""
        extras = []
        pull = h  # -2 dL/dq
        if self.drawn.rings is not None:
            dr = h * self.t / self.w  # dL/dr0
            extras += [dr.sum(1), (dr * self.t).sum(1)]
            pull = dr / self.r
        pull_u, pull_v = pull * self.u, pull * self.v  # -dL/du, -dL/dv
        if self.drawn.arcs is not None:
            extras += [(h * self.u).sum(1), (h * self.v).sum(1), -h.sum(1)]
            pull_u, pull_v = pull_u - h * self.a_u, pull_v - h * self.a_v
        # Sums over the pixels, times x, y, 1.
        sx_u, _, s_u = (self.pixels.T @ pull_u).unbind(1)
        sx_v, sy_v, s_v = (self.pixels.T @ pull_v).unbind(1)
        d_cx, d_cy = self.w_xx * s_u + self.w_yx * s_v, self.w_yy * s_v
        d_whitening = [self.cx * s_u - sx_u, self.cx * s_v - sx_v, self.cy * s_v - sy_v]
        return [d_cx, d_cy, *d_whitening, *extras]


def _origins(tiles: Tensor, columns: int) -> Tensor:
    """(b, 2) middles of the tiles, px."""
    return torch.stack([tiles % columns, tiles // columns], -1) * TILE + TILE / 2


def _with_nothing(drawn: Gaussians) -> Gaussians:
    """One row more, of a Gaussian that shows nothing, which fills up lists."""
    return Gaussians(*(  # type: ignore[arg-type]
        None if part is None else torch.cat([part, part.new_full((1, part.shape[1]), fill)])
        for part, fill in zip(drawn, (0.0, 0.0, 1.0, 0.0), strict=True)
    ))  # fmt: skip


class _Draw(torch.autograd.Function):
    """See `tiled.Draw`."""

    @staticmethod
    def forward(ctx: Any, lists: Lists, blend: Blend, median: bool, *parts: Tensor | None) -> Any:
        ctx.lists, ctx.blend = lists, blend
        drawn = _with_nothing(Gaussians(*parts))  # type: ignore[arg-type]
        n, channels = len(drawn.values) - 1, drawn.values.shape[1] - 1
        pixels = _pixels(drawn.values)
        picture = drawn.values.new_zeros(lists.columns * lists.rows, TILE * TILE, channels)
        halves = torch.full(picture.shape[:2], -1, dtype=torch.int64, device=picture.device)
        for tiles, entries in _groups(lists, n):
            total = torch.zeros_like(picture[tiles])
            before = torch.ones_like(total[..., :1])
            for index in entries.split(CHUNK, 1):
                chunk = _Chunk(drawn, index, _origins(tiles, lists.columns), pixels)
                weights, after = _weigh(chunk, blend, before)
                total.baddbmm_(weights, chunk.values)
                if blend == "add":
                    continue
                if median:
                    halves[tiles] = torch.maximum(halves[tiles], _half_lost(before, after, index))
                before = after[..., -1:]
                if float(before.max()) < TRANSMITTANCE_MIN:
                    break
            picture[tiles] = total
        ctx.save_for_backward(picture, *parts)
        ctx.mark_non_differentiable(halves)
        return picture, halves

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, _: Tensor) -> Any:
        picture, *parts = ctx.saved_tensors
        lists: Lists = ctx.lists
        drawn = _with_nothing(Gaussians(*parts))
        columns = [0 if part is None else part.shape[1] for part in (drawn.values, *drawn[:1], *drawn[2:])]
        sums = drawn.values.new_zeros(len(drawn.values), sum(columns))
        pixels = _pixels(drawn.values)
        for tiles, entries in _groups(lists, len(drawn.values) - 1):
            upstream = gradient[tiles]
            left = (upstream * picture[tiles]).sum(-1, keepdim=True)  # of the sum, behind the entry
            before = torch.ones_like(left)
            for index in entries.split(CHUNK, 1):
                chunk = _Chunk(drawn, index, _origins(tiles, lists.columns), pixels)
                weights, after = _weigh(chunk, ctx.blend, before)
                h = upstream @ chunk.values.transpose(1, 2)
                h *= weights
                if ctx.blend == "over":
                    behind = left - h.cumsum(-1)
                    # alpha / (1 - alpha), or 0 if the entry did not count
                    h.addcmul_(weights / after.clamp(min=AFTER_MIN), behind, value=-1)
                    left, before = behind[..., -1:], after[..., -1:]
                d_peaks = h.sum(1) / chunk.peaks[:, 0].clamp(min=ALPHA_MIN)
                d_values = weights.transpose(1, 2) @ upstream
                found = torch.stack([d_peaks, *d_values.unbind(-1), *chunk.backward(h)], -1)
                sums.index_add_(0, index.flatten(), found.flatten(0, 1))
                if ctx.blend == "over" and float(before.max()) < TRANSMITTANCE_MIN:
                    break
        values, places, rings, arcs = sums[:-1].split(columns, 1)
        return (
            None, None, None, places.to(drawn.places.dtype), values,
            None if drawn.rings is None else rings, None if drawn.arcs is None else arcs,
        )  # fmt: skip


def _weigh(chunk: _Chunk, blend: Blend, before: Tensor) -> tuple[Tensor, Tensor]:
    """Weights (b, pixels, k) of the entries, and the transmittances after them, from those before the chunk
    (b, pixels, 1)."""
    if blend == "add":
        return threshold(chunk.g, PROFILE_MIN, 0.0), before
    alpha = threshold(chunk.peaks * chunk.g, ALPHA_MIN, 0.0)
    after = torch.cumprod(1 - alpha, -1).mul_(before)
    reaching = torch.cat([before, after[..., :-1]], -1)
    return alpha.mul_(threshold(reaching, TRANSMITTANCE_MIN, 0.0)), after


def _half_lost(before: Tensor, after: Tensor, index: Tensor) -> Tensor:
    """(b, pixels) the row whose contribution takes the transmittance below 1/2, -1 where none of `index` does."""
    limit = torch.full_like(before, -0.5)
    place = torch.searchsorted(after.neg(), limit, right=True)[..., 0]  # in ascending order, as it must be
    crosses = (place < index.shape[1]) & (before[..., 0] >= 0.5)
    return torch.where(crosses, index.gather(1, place.clamp(max=index.shape[1] - 1)), -1)


def draw(lists: Lists, blend: Blend, median: bool, drawn: Gaussians) -> tuple[Tensor, Tensor]:
    """See `tiled.Draw`."""
    return _Draw.apply(lists, blend, median, *drawn)


rasterize_scene = partial(tiled.rasterize_scene, draw, TILE)
splat = partial(tiled.splat, draw, TILE)
